"""CPU back end: Numba kernels with explicit SIMD.

The modules follow the data: ``projection`` (parameters to packed splats), ``binning`` (splats to tiles),
``rasterise`` (tiles to pixels and back), ``gradients`` (back to the parameters), ``loss``, ``frame_warp``
(image formation) and ``elementwise`` (the rest). ``pipeline`` runs them on reusable buffers. Numba sets the
folder of its cache when a kernel is defined, so this package configures it first.
"""

from cleargs.splat.kernels.cpu.jit import configure_numba

configure_numba()
