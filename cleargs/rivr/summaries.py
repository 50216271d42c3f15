"""The figures of the trainings (g0, rivr, consolidate) in their manifests."""

from __future__ import annotations

from typing import Any

from pydantic import AliasChoices, Field

from cleargs.manifest import Summary
from cleargs.rivr.harm import HarmCheck


class TrainingSummary(Summary):
    """A figure of all three stages."""

    psnr_unseen: float | None = None
    """PSNR of pixels that no training saw, dB."""


class G0Summary(TrainingSummary):
    """Figures of the first scene."""

    views: int | None = None
    gaussians_start: int | None = None
    gaussians: int | None = None
    gaussians_dropped: int | None = None
    gaussians_drawn_in: int | None = None
    steps: int | None = None
    sh_degree: int | None = None
    exposure: bool | None = None
    """True if exposure compensation is on."""
    exposure_spread: float | None = None
    colour_spread: float | None = None
    moving_share: float | None = None
    psnr_strong: float | None = None
    psnr_active: float | None = None


class RepairSummary(TrainingSummary):
    """Figures of a stage that trains on repairs."""

    control: HarmCheck | None = Field(None, validation_alias=AliasChoices("control", "held_back"))
    """Harm on the control frames."""
    published: str | None = None
    """Scene that was published."""


class RivrSummary(RepairSummary):
    """Figures of RIVR."""

    expert: str | None = None
    rounds: list[dict[str, Any]] | None = None


class ConsolidateSummary(RepairSummary):
    """Figures of the consolidation."""

    repairs: int | None = None
    chosen: dict[str, int] | None = None
    latest_rounds: dict[str, int] | None = None
    scorer: str | None = None
