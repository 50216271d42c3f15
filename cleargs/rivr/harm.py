"""What keeps a scene distilled from repairs from doing harm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from pydantic import Field

from cleargs.base_model import Settings


class HarmConfig(Settings):
    """When a distilled scene counts as worse than G0 on the frames held back from repair.

    These frames stay among the raw supervision, as they were for G0. Kept from it too, G0 would be measured
    on frames it was trained on and the distilled scene on unseen ones: PSNR then falls by 2 to 3 dB while the
    scene gains 0.9 dB against the truth (16 frames, 480x270), and no margin tells harm from that.
    """

    held_back: float = Field(
        0.125,
        ge=0.0,
        le=1.0,
        description="share of the reliable frames (at least one) that get no repair and judge the result; "
        "0: every frame may be repaired and nothing is rejected, the paper's way.",
    )
    psnr_margin: float = Field(0.5, ge=0.0, le=100.0, description="mean PSNR may fall by this much, dB")
    score_margin: float = Field(1.0, ge=0.0, le=100.0, description="mean primary score may fall by this much")


class Fidelity(NamedTuple):
    """How well a scene explains the frames that were held back from repair: means over them."""

    psnr: float
    """PSNR of a frame's render, with the frame's motion, against its raw observation, dB."""
    score: float
    """Primary score of a render, 0-100, higher is better."""


@dataclass(frozen=True)
class HarmVerdict:
    """Whether a distilled scene may be published, with the figures that decided."""

    frames: list[int]
    """The frames held back; without any, nothing is judged."""
    psnr_before: float | None
    psnr_after: float | None
    score_before: float | None
    score_after: float | None
    harm: str | None
    """What became worse by more than its margin; None: the distilled scene is published."""


def judge_harm(
    frames: Sequence[int], before: Fidelity | None, after: Fidelity | None, limits: HarmConfig
) -> HarmVerdict:
    """Compare a distilled scene with G0 on the held-back ``frames``.

    Harm is a mean PSNR lower by more than ``psnr_margin`` dB, or a mean primary score lower by more than
    ``score_margin``: repairs may neither bend the scene away from its best observations nor soften it.
    Without frames there is no harm.
    """
    if before is None or after is None:
        return HarmVerdict([], None, None, None, None, harm=None)
    worse = []
    if after.psnr < before.psnr - limits.psnr_margin:
        worse.append(f"PSNR fell by {before.psnr - after.psnr:.2f} dB")
    if after.score < before.score - limits.score_margin:
        worse.append(f"primary score fell by {before.score - after.score:.2f}")
    harm = " and ".join(worse) or None
    return HarmVerdict(list(frames), before.psnr, after.psnr, before.score, after.score, harm)
