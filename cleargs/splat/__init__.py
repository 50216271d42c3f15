"""The Gaussian splatting core that every stage shares: cameras, Gaussians, rendering, losses, optimiser.

Nothing heavy is imported here, and Numba only where a CPU kernel is first needed. Start with
:func:`cleargs.splat.render.render` for a differentiable picture and with
:class:`cleargs.splat.kernels.rasteriser.Rasteriser` for training.
"""
