"""Constants of rendering, loss and optimiser, shared by all kernels and by their reference in float64.

The values of rendering are those of the Inria rasteriser (diff-gaussian-rasterization, ``forward.cu``) and of
gsplat. Scenes trained here therefore look the same in other viewers.
"""

from __future__ import annotations

import math

DILATION = 0.3
"""Variance in px² added to the diagonal of every projected covariance (the low-pass filter of EWA)."""

ALPHA_MAX = 0.999
"""Upper limit of a splat's alpha (gsplat; Inria: 0.99). The gradient of a clamped alpha is zero."""

ALPHA_CUT = 1.0 / 255.0
"""Lower limit of a splat's alpha: with less, the splat does not contribute to the pixel."""

TRANSMITTANCE_STOP = 1e-4
"""Compositing stops before the first splat that would reduce a pixel's transmittance below this."""

PIXEL_CENTRE = 0.5
"""Position in px of the centre of the first pixel: column ``i`` is centred at ``i + 0.5``, as in COLMAP."""

NEAR = 0.01
"""Near plane: Gaussians with a smaller camera z (scene units) of their centre are culled (gsplat)."""

VIEW_CLAMP = 0.3
"""Distance beyond each image edge, in half fields of view, at which the EWA Jacobian is clamped (gsplat)."""

QUATERNION_EPSILON = 1e-12
"""Lower limit of the norm by which a quaternion is divided. A zero quaternion is the identity rotation."""

LOG2_ALPHA_CUT = math.log2(ALPHA_CUT)

SH_DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}
"""Number of stored coefficients -> degree of the spherical harmonics."""

# Factors of the real spherical harmonics, in the order and with the signs of the Inria code
# (``sh_utils.py``).
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
"""Offset of the colour: sRGB = max(SH sum + 0.5, 0)."""

# As in the Inria code.
ADAM_BETAS = (0.9, 0.999)
ADAM_EPSILON = 1e-15

# Window (11 x 11 px) and stabilisers of SSIM (Wang et al. 2004), as in the Inria code.
SSIM_RADIUS = 5
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
