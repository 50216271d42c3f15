"""The constants of the image formation, shared by the oracle and by every kernel.

They are those of the Inria rasteriser (diff-gaussian-rasterization, ``forward.cu``) and of gsplat, so
that scenes trained here look the same in other people's viewers.
"""

from __future__ import annotations

import math

DILATION = 0.3
"""Variance in px² added to the diagonal of every projected covariance (the low-pass of EWA splatting)."""

ALPHA_MAX = 0.999
"""Upper clamp of a splat's alpha; gsplat's value (Inria: 0.99). Its gradient is zero where it acts."""

ALPHA_CUT = 1.0 / 255.0
"""A splat whose alpha at a pixel is smaller than this does not touch the pixel."""

TRANSMITTANCE_STOP = 1e-4
"""A pixel is finished before the first splat that would bring its transmittance below this."""

PIXEL_CENTRE = 0.5
"""Column ``i`` of an image is centred at ``i + 0.5`` px, as in COLMAP."""

NEAR = 0.01
"""Gaussians whose centre lies nearer than this (camera z, scene units) are culled."""

VIEW_CLAMP = 0.3
"""The EWA Jacobian is evaluated at most this many half fields of view beyond each image edge (gsplat)."""

QUATERNION_EPSILON = 1e-12
"""Lower bound of the norm that a quaternion is divided by; a zero quaternion is the identity rotation."""

LOG2_ALPHA_CUT = math.log2(ALPHA_CUT)

SH_DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}
"""Spherical-harmonics degree by number of stored coefficients."""

# Real spherical harmonics in the order and with the signs of the Inria code (``sh_utils.py``).
SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
)
SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
SH_OFFSET = 0.5
"""Colour = max(SH sum + 0.5, 0)."""

ADAM_BETAS = (0.9, 0.999)
ADAM_EPSILON = 1e-15

SSIM_RADIUS = 5
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
