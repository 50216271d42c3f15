"""How a run went, in words, and what stands in the way of a better one, each with the setting to change.

None of the thresholds here is calibrated. They are round numbers, chosen by judgement: no set of captures of
which people had said how good their scenes are was held against them. The figures behind the verdict are of
training poses, so it says how well a scene explains what was filmed, and not how new views look.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from cleargs.manifest import Manifest
from cleargs.pipeline.config import Config
from cleargs.report.formatting import count
from cleargs.report.frames import HELD_OUT, UNPLACED, FrameRow, last_scene

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


class Caution(NamedTuple):
    """Something that keeps the result from being better."""

    what: str
    why: str
    settings: tuple[str, ...] = ()
    """As ``--set`` takes them; empty where no setting helps."""


class ReportVerdict:
    """The first screen of a report of a run that shows these ``manifests``."""

    def __init__(self, manifests: Mapping[str, Manifest], rows: Sequence[FrameRow], config: Config) -> None:
        self._manifests, self._rows, self._config = manifests, rows, config
        self._placed = [row for row in rows if row.frame.registered]
        self._unused = sum(row.weight == 0.0 for row in self._placed)
        # PSNR of the first scene on the best frames of its training, dB, and the name of these frames.
        self._psnr, self._judged_on = self._figure("g0", "psnr_strong"), "the trusted training frames"
        if self._psnr is None:
            self._psnr, self._judged_on = self._figure("g0", "psnr_active"), "its training frames"

    def _figure(self, stage: str, *path: str) -> Any:
        """A figure that a stage reported; None without the stage or the figure."""
        value: Any = self._manifests[stage].summary if stage in self._manifests else None
        for name in path:
            value = value.get(name) if isinstance(value, Mapping) else None
        return value

    def _setting(self, section: str, name: str) -> Any:
        return getattr(self._config.sections[section], name)

    def headline(self) -> tuple[Tone, str]:
        """The tone and the first line."""
        if "g0" not in self._manifests:
            return "fair", "The capture is prepared; no scene is trained yet."
        if self._psnr is None:
            return "fair", "The scene is trained."
        follows = f"The first scene follows {self._judged_on}"
        if self._psnr >= CLOSE_DB:
            return "good", f"{follows} closely."
        if self._psnr >= LOOSE_DB:
            return "fair", f"{follows} fairly closely."
        return "poor", f"{follows} only loosely."

    def text(self) -> str:
        """The lines under the headline."""
        parts = [f"{len(self._placed)} of {count(len(self._rows), 'frame')} found their place in the scene"]
        if strong := sum(row.role == "strong" for row in self._rows):
            parts[0] += f", {strong} of them sharp and reliable enough to lead the training"
        if self._unused:
            parts.append(f"{count(self._unused, 'frame')} took no part in it")
        parts.append(self._harm())
        return " ".join(f"{part[0].upper()}{part[1:]}." for part in parts if part)

    def _harm(self) -> str:
        """The effect of the repairs on frames that no repair was trained on; "" where it is unknown."""
        stage = "consolidate" if "consolidate" in self._manifests else "rivr"
        before, after = (self._figure(stage, "held_back", f"psnr_{when}") for when in ("before", "after"))
        if before is None or after is None:
            return ""
        if self._figure(stage, "published") == "G0":
            return "the repairs did not pay off, so the first scene is also the last"
        none = self._figure("consolidate", "repairs") == 0
        lead = "no frame needed a repair; trained on" if none else "after the repairs"
        return (
            f"{lead}, the scene explains training frames that were kept aside from repairs "
            f"{abs(after - before):.1f} dB {'more' if after >= before else 'less'} exactly "
            f"({before:.1f} dB before, {after:.1f} dB now)"
        )

    def figures(self) -> Iterator[tuple[str, str, str]]:
        """The numbers of the first screen, each with its label and a note."""
        placed = f"{len(self._placed)} of {len(self._rows)}"
        yield placed, "frames placed", "with a pose that fits the others"
        if "rva" in self._manifests:
            active = sum(bool(row.weight) for row in self._rows)
            whole = f"as much as {self._figure('rva', 'effective_frames'):.1f} whole ones together"
            yield str(active), "frames train the scene", whole
        if self._psnr is not None:
            rule = f"by rule of thumb {CLOSE_DB:g} dB are close and less than {LOOSE_DB:g} loose"
            note = f"PSNR of the first scene on training poses; {rule}"
            yield f"{self._psnr:.1f} dB", f"on {self._judged_on}", note
        unseen = self._figure(last_scene(self._manifests) or "", "psnr_unseen")
        if unseen is not None:
            note = "PSNR of the last scene on a hundredth of every frame; views off the path are worse"
            yield f"{unseen:.1f} dB", "on pixels that no training saw", note
        repairs = self._figure("consolidate", "repairs")
        if repairs is not None:
            views = "repaired views" if repairs != 1 else "repaired view"
            yield str(repairs), views, "carried into the final scene"

    def warnings(self) -> Iterator[Caution]:
        """All cautions, in the order of the stages."""
        for manifest in self._manifests.values():
            for missing in manifest.missing:
                yield Caution(f"{manifest.stage} is done only in part", missing)
        yield from self._of_capture()
        yield from self._of_allocation()
        if "g0" in self._manifests:
            yield from self._of_scenes()

    def _of_capture(self) -> Iterator[Caution]:
        """The faults of the frames and their poses."""
        rows = self._rows
        unplaced = sum(row.role == UNPLACED for row in rows)
        available = self._figure("ingest", "frames_available") or 0
        more: tuple[str, ...] = ()  # the setting that limits the frames of a capture, where there are more
        if available > len(rows):
            fps = self._setting("ingest", "fps")
            if fps is not None and len(rows) < self._setting("ingest", "max_frames"):
                more = (f"ingest.fps={2 * fps:g}",)
            else:
                more = (f"ingest.max_frames={min(available, 2 * len(rows))}",)
        if rows and unplaced > (1.0 - FEW_PLACED) * len(rows):
            all_pairs = len(rows) < self._setting("ingest", "exhaustive_below")
            overlap = () if all_pairs else (f"ingest.overlap={2 * self._setting('ingest', 'overlap')}",)
            yield Caution(
                f"{count(unplaced, 'frame')} found no place",
                "They share too few points with their neighbours: too blurred, or too far apart.",
                more + overlap,
            )
        if available > 1.5 * len(rows):
            why = "More frames bring more views of every surface, at more time."
            yield Caution(f"{len(rows)} of {available} frames were used", why, more)
        if rows and not any(row.role == HELD_OUT for row in rows):
            why = "All figures here are of frames that the scene has seen; new views may look worse."
            yield Caution("No frame was held out", why, ("ingest.holdout=every:8",))

    def _of_allocation(self) -> Iterator[Caution]:
        """The faults that RVA found."""
        lower = f"rva.tau_R={max(self._setting('rva', 'tau_R') - 0.1, 0.0):.2f}"
        if self._figure("rva", "stand_in"):
            yield Caution(
                "No frame counts as reliable",
                "The best of them are used instead. Thresholds nearer to this capture would separate good "
                "frames from bad ones.",
                (lower, f"rva.tau_B={min(self._setting('rva', 'tau_B') + 0.1, 1.0):.2f}"),
            )
        if uncovered := self._figure("rva", "bins_uncovered_before"):
            yield Caution(
                f"{count(uncovered, 'stretch', 'stretches')} of the path had no good frame",
                "Weak frames were taken back there, at low weight, and the scene is softer. "
                "Film slower there.",
            )
        weighted = sum(row.weight is not None for row in self._placed)
        if weighted and self._unused > MANY_UNUSED * weighted:
            why = "A lower threshold of reliability lets more of them in."
            yield Caution(f"{self._unused} of {weighted} placed frames are unused", why, (lower,))
        blurred = sum((row.motion("blur_px") or 0.0) > SOFT_PX for row in self._rows)
        if blurred > len(self._rows) / 2:
            what = f"{count(blurred, 'frame')} moved by more than {SOFT_PX:g} px while exposed"
            yield Caution(what, "A shorter exposure or a slower hand gives sharper frames than any repair.")

    def _of_scenes(self) -> Iterator[Caution]:
        """The faults that the trainings found."""
        psnr = self._figure("g0", "psnr_strong")
        if psnr is not None and psnr < CLOSE_DB:
            size = self._setting("ingest", "max_size") * 3 // 2
            yield Caution(
                f"The first scene reaches {psnr:.1f} dB on the frames it trusts",
                "A longer training, or larger images, bring out finer detail.",
                (f"g0.steps={2 * self._figure('g0', 'steps')}", f"ingest.max_size={size}"),
            )
        spread = self._figure("g0", "exposure_spread") or 0.0
        if spread > self._setting("g0", "exposure_threshold") and not self._figure("g0", "exposure"):
            yield Caution(
                f"Exposure differs by {100 * spread:.0f} % between frames",
                "Without compensation the scene takes on their average, with floating haze.",
                ("g0.exposure=auto",),
            )
        for stage in ("rivr", "consolidate"):
            if harm := self._figure(stage, "held_back", "harm"):
                yield Caution(
                    f"The scene of {stage} was rejected",
                    f"It explains frames kept aside worse than before ({harm}), so the one before it stays.",
                    ("rivr.harm.psnr_margin=1.0", f"{stage}.distil.pseudo_share=0.4"),
                )
        rounds = self._figure("rivr", "rounds") or []
        refused = sum(found["repairs_refused"] for found in rounds)
        made = sum(sum(found["chosen"].values()) for found in rounds)
        if made and 2 * refused > made:
            yield Caution(
                f"{refused} of {made} repairs were refused",
                "They agree with neither the frame nor the render: the repair model does not suit this "
                "capture. `cleargs models list` names others.",
                ("rivr.expert=NAME",),
            )
