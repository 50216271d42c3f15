"""The check for harm that a scene distilled from repairs must pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from pydantic import AliasChoices, Field

from cleargs.base_model import FrozenModel


class HarmConfig(FrozenModel):
    """Margins beyond which a distilled scene is worse than G0 on the control frames.

    These frames remain in the raw supervision, as for G0. Otherwise the distilled scene would be measured on
    unseen frames: PSNR falls by 2 to 3 dB while the scene gains 0.9 dB against the truth (16 frames,
    480x270), and no margin can separate harm from that.
    """

    control: float = Field(
        0.125,
        validation_alias=AliasChoices("control", "held_back"),
        ge=0.0,
        le=1.0,
        description="control frames: this share of the reliable frames (at least one) gets no repair and "
        "measures harm; 0: every frame may be repaired and nothing is rejected, the paper's way.",
    )
    psnr_margin: float = Field(0.5, ge=0.0, le=100.0, description="mean PSNR may fall by this much, dB")
    score_margin: float = Field(1.0, ge=0.0, le=100.0, description="mean primary score may fall by this much")


class Fidelity(NamedTuple):
    """Agreement of a scene with the control frames: means over them."""

    psnr: float
    """PSNR of a frame's render, with the frame's motion, against the frame image, dB."""
    score: float
    """Primary score of a render, 0-100, higher is better."""


@dataclass(frozen=True)
class HarmCheck:
    """The decision about a distilled scene, with the figures behind it."""

    frames: list[int]
    """The control frames. Without any, every scene is published."""
    psnr_before: float | None = None
    psnr_after: float | None = None
    score_before: float | None = None
    score_after: float | None = None
    harm: str | None = None
    """The figure that fell by more than its margin; None if the distilled scene is published."""


def compare_on_controls(
    frames: Sequence[int], before: Fidelity | None, after: Fidelity | None, limits: HarmConfig
) -> HarmCheck:
    """Compare a distilled scene with G0 on the control frames ``frames``; without any there is no harm.

    Harm is a fall of the mean PSNR or of the mean primary score by more than its margin: repairs may neither
    bend the scene away from its best observations nor soften it.
    """
    if before is None or after is None:
        return HarmCheck([])
    worse = []
    if after.psnr < before.psnr - limits.psnr_margin:
        worse.append(f"PSNR fell by {before.psnr - after.psnr:.2f} dB")
    if after.score < before.score - limits.score_margin:
        worse.append(f"primary score fell by {before.score - after.score:.2f}")
    harm = " and ".join(worse) or None
    return HarmCheck(list(frames), before.psnr, after.psnr, before.score, after.score, harm)
