"""CPU back end: Numba kernels with explicit SIMD.

The modules follow the data: ``projection`` (parameters to packed splats), ``binning`` (splats to tiles),
``rasterise`` (tiles to pixels and back, by ``pixel``), ``gradients`` (back to the parameters), ``loss``,
``frame_warp`` (image formation) and ``elementwise`` (the rest); ``pipeline`` runs them over reusable buffers.
``splat_layout`` names the columns of what they hand on, ``simd`` is the vector type.

Numba fixes the place of its cache when a kernel is defined, hence the one call below.
"""

from cleargs.splat.kernels.cpu.jit import configure_numba

configure_numba()
