"""Pixels that stay unexplained count less: what moves in front of the camera must not teach the scene."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate

CELLS = 24
"""Cells along the longer side of a frame. Over a cell, detail that is missing or lies a little beside its
place cancels out; what does not belong to the scene does not."""

ORDINARY = 5.0
"""Multiple of the frame's median difference that is an ordinary one still: where all of a frame differs, as
with an exposure that is not known yet, nothing moves."""

NONE = 1e-6
"""Difference, and share of the pixels, that stands for none."""


@dataclass(frozen=True, eq=False)
class Doubt:
    """What a frame must be explained as, and how well, lest its pixels count less."""

    target: Tensor
    """The frame as taken, [H, W, 3] sRGB."""
    mask: Tensor | None
    """[H, W], True counts."""
    tolerance: float
    """Difference in sRGB, of [0, 1], up to which every pixel counts."""

    def counts(self, photograph: Tensor) -> Tensor:
        """How much each pixel counts, [H, W] in (0, 1], where the scene gives ``photograph`` [H, W, 3] sRGB.

            w = min(1, rho / r)^2,  rho = max(tolerance, 5 median r)

        r is the difference of the mean colours of a cell, interpolated between the cells. Where it is below
        rho, w is 1 to the bit. Differences are pooled as in Sabour et al., "RobustNeRF" (2023).
        """
        height, width = photograph.shape[:2]
        per_pixel = CELLS / max(height, width)
        cells = max(1, round(per_pixel * height)), max(1, round(per_pixel * width))
        counted = torch.ones_like(photograph[..., 0]) if self.mask is None else self.mask.float()
        difference = (photograph - self.target).permute(2, 0, 1) * counted
        shares = adaptive_avg_pool2d(counted[None], cells).clamp_min(NONE)
        unexplained = (adaptive_avg_pool2d(difference, cells) / shares).abs().mean(dim=0)
        ordinary = (ORDINARY * unexplained.median()).clamp_min(self.tolerance)
        here = interpolate(unexplained[None, None], (height, width), mode="bilinear")[0, 0]
        return (ordinary / here.clamp_min(NONE)).clamp_max(1.0).square()
