"""The outcome of a report: the quality of the result in words and one figure.

The thresholds are round numbers, chosen by judgement. They are not calibrated by people's ratings of scenes.
Figures of training poses measure how well a scene matches the video, not the quality of new views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Literal, NamedTuple

from cleargs.manifest import Manifest
from cleargs.report.formatting import count
from cleargs.report.frames import SCENES, FrameRow
from cleargs.rivr.summaries import ConsolidateSummary, G0Summary, RepairSummary, TrainingSummary
from cleargs.splat.config import steps_from_frames

GOOD_DB, FAIR_DB = 28.0, 22.0
"""PSNR from which the scene matches the frames closely, and below which it does so loosely. The PSNR of a
good scene depends on the noise and the texture of the capture."""

Tone = Literal["good", "fair", "poor"]

SHORT = 0.8
"""A training with a smaller share of the standard steps counts as short."""

HEADLINES: Mapping[Tone, str] = {
    "good": "Good: the scene matches the {source} closely{after}.",
    "fair": "Fair: the scene matches the {source} reasonably well{after}.",
    "poor": "Poor: the scene matches the {source} only loosely{after}.",
}


class Outcome(NamedTuple):
    """The first lines of a report."""

    tone: Tone
    headline: str
    text: str
    figure: str
    """PSNR in dB of pixels that no training used; "" if it is unknown."""


def outcome(manifests: Mapping[str, Manifest], rows: Sequence[FrameRow], unseen: Sequence[float]) -> Outcome:
    """Return the first lines of a report. ``unseen`` is the PSNR, dB, of each frame that was held out."""
    known = [TrainingSummary.of(manifests.get(stage)).psnr_unseen for stage in reversed(SCENES)]
    psnr = next((value for value in known if value is not None), None)
    text = _text(manifests, rows, unseen)
    if psnr is None:
        trained = "g0" in manifests
        headline = "The scene is trained." if trained else "The capture is prepared. No scene is trained yet."
        return Outcome("fair", headline, text, "")
    tone: Tone = "good" if psnr >= GOOD_DB else "fair" if psnr >= FAIR_DB else "poor"
    filmed = any(row.frame.time_s is not None for row in rows)
    after = " after a short training" if short_training(manifests, rows) else ""
    headline = HEADLINES[tone].format(source="video" if filmed else "photographs", after=after)
    return Outcome(tone, headline, text, f"{psnr:.1f}")


def short_training(manifests: Mapping[str, Manifest], rows: Sequence[FrameRow]) -> tuple[int, int] | None:
    """Return the steps of the first training and the standard number, if it had less than `SHORT` of them."""
    steps = G0Summary.of(manifests.get("g0")).steps or 0
    standard = steps_from_frames(sum(bool(row.weight) for row in rows))
    return (steps, standard) if "g0" in manifests and steps < SHORT * standard else None


def _text(manifests: Mapping[str, Manifest], rows: Sequence[FrameRow], unseen: Sequence[float]) -> str:
    """Return the sentence below the headline."""
    placed = sum(row.frame.registered for row in rows)
    parts = [f"{placed} of {count(len(rows), 'frame')} placed"]
    if any(row.weight is not None for row in rows):
        used = [row for row in rows if row.weight]
        simulated = sum(row.modelled for row in used)
        parts.append(f"{len(used)} used in training, {simulated} with simulated blur, skew or defocus")
    repaired = ConsolidateSummary.of(manifests.get("consolidate")).repairs
    if repaired is not None:
        parts.append(f"{repaired} repaired")
    checks = [RepairSummary.of(manifests.get(stage)).control for stage in SCENES]
    if any(check is not None and check.harm for check in checks):
        parts.append("a scene with repairs was rejected, since it matched other frames worse")
    if unseen:
        held = f"{count(len(unseen), 'frame')} that {'was' if len(unseen) == 1 else 'were'} held out"
        parts.append(f"{fmean(unseen):.1f} dB at {held}, with aligned colours")
    return "; ".join(parts) + "."
