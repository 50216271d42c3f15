"""Gaussian splatting for all stages: cameras, Gaussians, rendering, losses and the optimiser.

Importing this package is fast. Numba is imported when a CPU kernel is first needed. Start with
`cleargs.splat.render.render` for a differentiable image, and with
`cleargs.splat.kernels.rasteriser.Rasteriser` for training.
"""
