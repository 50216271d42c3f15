"""Settings of an evaluation: its metrics, and what it may adjust before measuring."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from cleargs.base_model import FrozenModel

LpipsNet = Literal["alex", "vgg"]

LPIPS_NETS: tuple[LpipsNet, ...] = ("alex", "vgg")
INSTALLABLE = ("musiq", "clip-iqa")
"""Scorers that the user installs; without them their scores are null."""

SCORERS = ("clarity-net", "naturalness-stats", *INSTALLABLE)
"""No-reference scorers: the two of ClearGS, and the two of the paper if they are installed."""


class EvalOptions(FrozenModel):
    """Metrics in addition to PSNR and SSIM, and adjustments, which are off by default and recorded."""

    lpips: tuple[LpipsNet, ...] = Field(LPIPS_NETS, description="Backbones of LPIPS v0.1.")
    scorers: tuple[str, ...] = Field(
        SCORERS, description="No-reference scorers: names, or paths of ONNX files."
    )
    align_colour: bool = Field(
        False, description="Map each image by the affine on sRGB that fits its reference best."
    )
    refine_poses: int = Field(
        0, ge=0, le=200, description="Steps of fitting each rendered pose to its reference image; 0 = off."
    )

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of all metrics, in the order of tables."""
        return ("psnr", "ssim", *(f"lpips_{net}" for net in self.lpips), *self.scorers)
