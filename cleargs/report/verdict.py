"""How a run went, in words, and what stands in the way of a better one, each with the setting to change.

None of the thresholds here is calibrated. They are round numbers, chosen by judgement: no set of captures of
which people had said how good their scenes are was held against them. The figures behind the verdict are of
training poses, so it says how well a scene explains what was filmed, and not how new views look.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from cleargs.manifest import Manifest
from cleargs.pipeline.config import Config
from cleargs.report.frame_strip import HELD_OUT, UNPLACED, FrameRow
from cleargs.report.words import count, decibel

CLOSE_DB, LOOSE_DB = 28.0, 22.0
"""Training PSNR from which a scene is said to follow its frames closely, and below which only loosely. What
a number means depends on the noise and the texture of the capture."""
FEW_PLACED = 0.8
"""Share of frames with a pose, below which the others are cautioned about."""
MANY_UNUSED = 0.4
"""Share of placed frames with weight 0, above which they are cautioned about."""
SOFT_PX = 6.0
"""Motion while exposed, px, above which a frame counts as blurred."""

Tone = Literal["good", "fair", "poor"]


@dataclass(frozen=True)
class Caution:
    """Something that keeps the result from being better."""

    what: str
    why: str
    settings: tuple[str, ...]
    """As ``--set`` takes them; empty where no setting helps."""


@dataclass(frozen=True)
class Figure:
    """A number that stands for a part of the run."""

    value: str
    label: str
    note: str


@dataclass(frozen=True)
class Verdict:
    """What the first screen of a report says."""

    tone: Tone
    headline: str
    text: str
    figures: tuple[Figure, ...]
    warnings: tuple[Caution, ...]


def judge(manifests: Mapping[str, Manifest], rows: Sequence[FrameRow], config: Config) -> Verdict:
    """The verdict on a run that shows these ``manifests``."""
    warnings = tuple(_warnings(manifests, rows, config))
    tone, headline = _headline(manifests)
    return Verdict(tone, headline, _text(manifests, rows), tuple(_figures(manifests, rows)), warnings)


def _figure(manifests: Mapping[str, Manifest], stage: str, *path: str) -> Any:
    """A figure that a stage reported; None without the stage or the figure."""
    value: Any = manifests[stage].summary if stage in manifests else None
    for name in path:
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


def _setting(config: Config, section: str, name: str) -> Any:
    return getattr(config.sections[section], name)


def _headline(manifests: Mapping[str, Manifest]) -> tuple[Tone, str]:
    if "g0" not in manifests:
        return "fair", "The capture is prepared; no scene is trained yet."
    psnr, frames = training_psnr(manifests)
    if psnr is None:
        return "fair", "The scene is trained."
    follows = f"The first scene follows {frames}"
    if psnr >= CLOSE_DB:
        return "good", f"{follows} closely."
    if psnr >= LOOSE_DB:
        return "fair", f"{follows} fairly closely."
    return "poor", f"{follows} only loosely."


def training_psnr(manifests: Mapping[str, Manifest]) -> tuple[float | None, str]:
    """PSNR of the first scene on the best frames that it was trained on, dB, and what these are called."""
    strong = _figure(manifests, "g0", "psnr_strong")
    if strong is not None:
        return strong, "the trusted training frames"
    return _figure(manifests, "g0", "psnr_active"), "its training frames"


def _text(manifests: Mapping[str, Manifest], rows: Sequence[FrameRow]) -> str:
    placed = sum(row.frame.registered for row in rows)
    roles = [row.role for row in rows]
    parts = [f"{placed} of {count(len(rows), 'frame')} found their place in the scene"]
    if strong := roles.count("strong"):
        parts[0] += f", {strong} of them sharp and reliable enough to lead the training"
    unused = sum(row.weight == 0.0 for row in rows if row.frame.registered)
    if unused:
        parts.append(f"{count(unused, 'frame')} took no part in it")
    held = _harm(manifests)
    if held is not None:
        parts.append(held)
    return ". ".join(part[:1].upper() + part[1:] for part in parts) + "."


def _harm(manifests: Mapping[str, Manifest]) -> str | None:
    """What the repairs did to frames that no repair was trained on."""
    stage = "consolidate" if "consolidate" in manifests else "rivr"
    before, after = (_figure(manifests, stage, "held_back", f"psnr_{when}") for when in ("before", "after"))
    if before is None or after is None:
        return None
    if _figure(manifests, stage, "published") == "G0":
        return "the repairs did not pay off, so the first scene is also the last"
    change = after - before
    kind = "more" if change >= 0 else "less"
    none = _figure(manifests, "consolidate", "repairs") == 0
    lead = "no frame needed a repair; trained on" if none else "after the repairs"
    return (
        f"{lead}, the scene explains training frames that were kept aside from repairs "
        f"{abs(change):.1f} dB {kind} exactly ({decibel(before)} before, {decibel(after)} now)"
    )


def _figures(manifests: Mapping[str, Manifest], rows: Sequence[FrameRow]) -> Iterator[Figure]:
    placed = sum(row.frame.registered for row in rows)
    yield Figure(f"{placed} of {len(rows)}", "frames placed", "with a pose that fits the others")
    active = sum(bool(row.weight) for row in rows)
    if "rva" in manifests:
        effective = _figure(manifests, "rva", "effective_frames")
        yield Figure(f"{active}", "frames train the scene", f"as much as {effective:.1f} whole ones together")
    psnr, frames = training_psnr(manifests)
    if psnr is not None:
        rule = f"by rule of thumb {CLOSE_DB:g} dB are close and less than {LOOSE_DB:g} loose"
        yield Figure(decibel(psnr), f"on {frames}", f"PSNR of the first scene on training poses; {rule}")
    scenes = [stage for stage in ("consolidate", "rivr", "g0") if stage in manifests]
    unseen = _figure(manifests, scenes[0], "psnr_unseen") if scenes else None
    if unseen is not None:
        yield Figure(
            decibel(unseen),
            "on pixels that no training saw",
            "PSNR of the last scene on a hundredth of every frame; views off the path are worse",
        )
    repairs = _figure(manifests, "consolidate", "repairs")
    if repairs is not None:
        yield Figure(
            str(repairs),
            "repaired views" if repairs != 1 else "repaired view",
            "carried into the final scene",
        )


def _warnings(
    manifests: Mapping[str, Manifest], rows: Sequence[FrameRow], config: Config
) -> Iterator[Caution]:
    for manifest in manifests.values():
        for missing in manifest.missing:
            yield Caution(f"{manifest.stage} is done only in part", missing, ())
    yield from _capture_warnings(manifests, rows, config)
    yield from _allocation_warnings(manifests, rows, config)
    if "g0" in manifests:
        yield from _scene_warnings(manifests, config)


def _capture_warnings(
    manifests: Mapping[str, Manifest], rows: Sequence[FrameRow], config: Config
) -> Iterator[Caution]:
    unplaced = sum(row.role == UNPLACED for row in rows)
    available = _figure(manifests, "ingest", "frames_available") or 0
    if rows and unplaced > (1.0 - FEW_PLACED) * len(rows):
        yield Caution(
            f"{count(unplaced, 'frame')} found no place",
            "They share too few points with their neighbours: too blurred, or too far apart.",
            tuple(_closer(len(rows), available, config)),
        )
    if available > 1.5 * len(rows):
        yield Caution(
            f"{len(rows)} of {available} frames were used",
            "More frames bring more views of every surface, at more time.",
            tuple(_more_frames(len(rows), available, config)),
        )
    if rows and not any(row.role == HELD_OUT for row in rows):
        yield Caution(
            "No frame was held out",
            "All figures here are of frames that the scene has seen; new views may look worse.",
            ("ingest.holdout=every:8",),
        )


def _closer(frames: int, available: int, config: Config) -> Iterator[str]:
    """Settings that bring frames nearer to each other, or compare more of them."""
    yield from _more_frames(frames, available, config)
    if frames >= _setting(config, "ingest", "exhaustive_below"):  # below it all pairs are compared
        yield f"ingest.overlap={2 * _setting(config, 'ingest', 'overlap')}"


def _more_frames(frames: int, available: int, config: Config) -> Iterator[str]:
    """The setting that limits the frames of a capture, where there are more."""
    fps, most = _setting(config, "ingest", "fps"), _setting(config, "ingest", "max_frames")
    if available <= frames:
        return
    if fps is not None and frames < most:
        yield f"ingest.fps={2 * fps:g}"
    else:
        yield f"ingest.max_frames={min(available, 2 * frames)}"


def _allocation_warnings(
    manifests: Mapping[str, Manifest], rows: Sequence[FrameRow], config: Config
) -> Iterator[Caution]:
    if _figure(manifests, "rva", "stand_in"):
        yield Caution(
            "No frame counts as reliable",
            "The best of them are used instead. Thresholds nearer to this capture would separate good frames "
            "from bad ones.",
            tuple(
                f"rva.{name}={min(max(_setting(config, 'rva', name) + step, 0.0), 1.0):.2f}"
                for name, step in (("tau_R", -0.1), ("tau_B", 0.1))
            ),
        )
    uncovered = _figure(manifests, "rva", "bins_uncovered_before") or 0
    if uncovered:
        yield Caution(
            f"{count(uncovered, 'stretch', 'stretches')} of the path had no good frame",
            "Weak frames were taken back there, at low weight, and the scene is softer. Film slower there.",
            (),
        )
    placed = [row for row in rows if row.frame.registered and row.weight is not None]
    unused = sum(row.weight == 0.0 for row in placed)
    if placed and unused > MANY_UNUSED * len(placed):
        yield Caution(
            f"{unused} of {len(placed)} placed frames are unused",
            "A lower threshold of reliability lets more of them in.",
            (f"rva.tau_R={max(0.0, _setting(config, 'rva', 'tau_R') - 0.1):.2f}",),
        )
    blurred = [row for row in rows if (row.blur_px or 0.0) > SOFT_PX]
    if len(blurred) > len(rows) / 2:
        yield Caution(
            f"{count(len(blurred), 'frame')} moved by more than {SOFT_PX:g} px while exposed",
            "A shorter exposure or a slower hand gives sharper frames than any repair.",
            (),
        )


def _scene_warnings(manifests: Mapping[str, Manifest], config: Config) -> Iterator[Caution]:
    psnr = _figure(manifests, "g0", "psnr_strong")
    if psnr is not None and psnr < CLOSE_DB:
        yield Caution(
            f"The first scene reaches {decibel(psnr)} on the frames it trusts",
            "A longer training, or larger images, bring out finer detail.",
            (
                f"g0.steps={2 * _figure(manifests, 'g0', 'steps')}",
                f"ingest.max_size={_setting(config, 'ingest', 'max_size') * 3 // 2}",
            ),
        )
    spread = _figure(manifests, "g0", "exposure_spread")
    threshold = _setting(config, "g0", "exposure_threshold")
    if spread is not None and spread > threshold and not _figure(manifests, "g0", "exposure"):
        yield Caution(
            f"Exposure differs by {100 * spread:.0f} % between frames",
            "Without compensation the scene takes on their average, with floating haze.",
            ("g0.exposure=auto",),
        )
    for stage in ("rivr", "consolidate"):
        harm = _figure(manifests, stage, "held_back", "harm")
        if harm:
            yield Caution(
                f"The scene of {stage} was rejected",
                f"It explains frames kept aside worse than before ({harm}), so the one before it stays.",
                ("rivr.harm.psnr_margin=1.0", f"{stage}.distil.pseudo_share=0.4"),
            )
    rounds = _figure(manifests, "rivr", "rounds") or []
    refused = sum(found["repairs_refused"] for found in rounds)
    made = sum(sum(found["chosen"].values()) for found in rounds)
    if made and 2 * refused > made:
        yield Caution(
            f"{refused} of {made} repairs were refused",
            "They agree with neither the frame nor the render: the repair model does not suit this capture. "
            "`cleargs models list` names others.",
            ("rivr.expert=NAME",),
        )
