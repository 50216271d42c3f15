"""The verdict of a report: the quality of the result in words, and settings that may improve it.

The thresholds are round numbers, chosen by judgement. They are not calibrated by people's ratings of scenes.
The figures behind the verdict are for training poses: they measure how well a scene matches the video, not
the quality of new views.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from cleargs.manifest import Manifest
from cleargs.pipeline.config import Config
from cleargs.report.formatting import count
from cleargs.report.frames import HELD_OUT, UNPLACED, FrameRow, last_scene

CLOSE_DB, LOOSE_DB = 28.0, 22.0
"""PSNR on training frames from which the match is close, and below which it is loose. The PSNR of a good
scene depends on the noise and the texture of the capture."""
FEW_PLACED = 0.8
"""Share of frames with a pose, below which the page has a caution."""
MANY_UNUSED = 0.4
"""Share of placed frames with weight 0, above which the page has a caution."""
BLURRED_PX = 6.0
"""Motion blur above which a frame counts as blurred, px."""

Tone = Literal["good", "fair", "poor"]


class Caution(NamedTuple):
    """Something that keeps the result from being better."""

    what: str
    why: str
    settings: tuple[str, ...] = ()
    """Arguments of ``--set``; empty if no setting helps."""


class ReportVerdict:
    """The texts and figures on the first screen of a report.

    Args:
        manifests: Stage -> manifest of the results that the report shows.
        rows: The frames.
        config: Settings of the run.
    """

    def __init__(self, manifests: Mapping[str, Manifest], rows: Sequence[FrameRow], config: Config) -> None:
        self._manifests, self._rows, self._config = manifests, rows, config
        self._placed = [row for row in rows if row.frame.registered]
        self._unused = sum(row.weight == 0.0 for row in self._placed)
        # PSNR in dB of the first scene on the best training frames, and a description of these frames.
        self._psnr, self._compared = self._figure("g0", "psnr_strong"), "the best training frames"
        if self._psnr is None:
            self._psnr, self._compared = self._figure("g0", "psnr_active"), "the training frames"

    def _figure(self, stage: str, *path: str) -> Any:
        """Return a figure from the summary of a stage; None without the stage or the figure."""
        value: Any = self._manifests[stage].summary if stage in self._manifests else None
        for name in path:
            value = value.get(name) if isinstance(value, Mapping) else None
        return value

    def _setting(self, section: str, name: str) -> Any:
        return getattr(self._config.sections[section], name)

    def headline(self) -> tuple[Tone, str]:
        """Return the tone and the first line."""
        if "g0" not in self._manifests:
            return "fair", "The capture is prepared. No scene is trained yet."
        if self._psnr is None:
            return "fair", "The scene is trained."
        matches = f"the first scene matches {self._compared}"
        if self._psnr >= CLOSE_DB:
            return "good", f"Good: {matches} closely."
        if self._psnr >= LOOSE_DB:
            return "fair", f"Fair: {matches} reasonably well."
        return "poor", f"Poor: {matches} only loosely."

    def text(self) -> str:
        """Return the text below the headline."""
        parts = [f"ClearGS placed {len(self._placed)} of {count(len(self._rows), 'frame')} in the scene"]
        if strong := sum(row.role == "strong" for row in self._rows):
            parts[0] += f", {strong} of them sharp and reliable (role strong)"
        if self._unused:
            parts.append(f"training did not use {count(self._unused, 'placed frame')}")
        parts.append(self._effect_of_repairs())
        return " ".join(f"{part[0].upper()}{part[1:]}." for part in parts if part)

    def _effect_of_repairs(self) -> str:
        """Return a sentence on the frames that were not repaired (the judges); "" if it is unknown."""
        stage = "consolidate" if "consolidate" in self._manifests else "rivr"
        before, after = (self._figure(stage, "held_back", f"psnr_{when}") for when in ("before", "after"))
        if before is None or after is None:
            return ""
        if self._figure(stage, "published") == "G0":
            return "the repairs did not improve the scene, so the first scene is the final scene"
        none = self._figure("consolidate", "repairs") == 0
        lead = "no frame needed a repair. With further training" if none else "with the repairs"
        return (
            f"{lead}, PSNR on reliable frames that were not repaired "
            f"{'rose' if after >= before else 'fell'} from {before:.1f} dB to {after:.1f} dB"
        )

    def figures(self) -> Iterator[tuple[str, str, str]]:
        """Yield the numbers of the first screen, each as (number, label, note)."""
        placed = f"{len(self._placed)} of {len(self._rows)}"
        yield placed, "frames placed", "with a known camera pose"
        if "rva" in self._manifests:
            active = sum(bool(row.weight) for row in self._rows)
            effective = f"{self._figure('rva', 'effective_frames'):.1f}"
            yield str(active), "frames used in training", f"equivalent to {effective} equally weighted frames"
        if self._psnr is not None:
            rule = f"rule of thumb: close from {CLOSE_DB:g} dB, loose below {LOOSE_DB:g} dB"
            yield f"{self._psnr:.1f} dB", f"PSNR on {self._compared}", f"first scene; {rule}"
        unseen = self._figure(last_scene(self._manifests) or "", "psnr_unseen")
        if unseen is not None:
            note = "last scene, 1 % of each frame; views away from the camera path are worse"
            yield f"{unseen:.1f} dB", "PSNR on pixels that no training used", note
        repairs = self._figure("consolidate", "repairs")
        if repairs is not None:
            views = "repaired views" if repairs != 1 else "repaired view"
            yield str(repairs), views, "used for the final scene"

    def warnings(self) -> Iterator[Caution]:
        """Yield all cautions, in the order of the stages."""
        for manifest in self._manifests.values():
            for missing in manifest.missing:
                yield Caution(f"{manifest.stage} is incomplete", missing)
        yield from self._capture_cautions()
        yield from self._allocation_cautions()
        if "g0" in self._manifests:
            yield from self._scene_cautions()

    def _capture_cautions(self) -> Iterator[Caution]:
        """Yield cautions about the frames and their poses."""
        rows = self._rows
        unplaced = sum(row.role == UNPLACED for row in rows)
        available = self._figure("ingest", "frames_available") or 0
        more: tuple[str, ...] = ()  # the setting that limits the number of frames, if the capture has more
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
                f"{count(unplaced, 'frame has', 'frames have')} no pose",
                "They share too few points with their neighbours: they are too blurred or too far apart.",
                more + overlap,
            )
        if available > 1.5 * len(rows):
            why = "More frames show each surface from more views, but take more time."
            yield Caution(f"{len(rows)} of {available} frames were used", why, more)
        if rows and not any(row.role == HELD_OUT for row in rows):
            why = "All figures here are for frames that the scene was trained on. New views may look worse."
            yield Caution("No frame was held out", why, ("ingest.holdout=every:8",))

    def _allocation_cautions(self) -> Iterator[Caution]:
        """Yield cautions about the weights of the frames."""
        lower = f"rva.tau_R={max(self._setting('rva', 'tau_R') - 0.1, 0.0):.2f}"
        if self._figure("rva", "stand_in"):
            yield Caution(
                "No frame counts as reliable",
                "The best frames are used instead. Thresholds closer to the scores of this capture would "
                "separate good frames from bad frames.",
                (lower, f"rva.tau_B={min(self._setting('rva', 'tau_B') + 0.1, 1.0):.2f}"),
            )
        if uncovered := self._figure("rva", "bins_uncovered_before"):
            yield Caution(
                f"{count(uncovered, 'stretch', 'stretches')} of the path had no good frame",
                "Weak frames are used there at low weight, so the scene is softer. Film more slowly there.",
            )
        weighted = sum(row.weight is not None for row in self._placed)
        if weighted and self._unused > MANY_UNUSED * weighted:
            why = "A lower reliability threshold would use more of them."
            yield Caution(f"{self._unused} of {weighted} placed frames are not used", why, (lower,))
        blurred = sum((row.motion("blur_px") or 0.0) > BLURRED_PX for row in self._rows)
        if blurred > len(self._rows) / 2:
            what = f"{count(blurred, 'frame has', 'frames have')} more than {BLURRED_PX:g} px of motion blur"
            yield Caution(
                what, "Shorter exposure or slower camera motion gives sharper frames than any repair."
            )

    def _scene_cautions(self) -> Iterator[Caution]:
        """Yield cautions about the trainings."""
        psnr = self._figure("g0", "psnr_strong")
        if psnr is not None and psnr < CLOSE_DB:
            size = self._setting("ingest", "max_size") * 3 // 2
            yield Caution(
                f"The first scene reaches only {psnr:.1f} dB on the best training frames",
                "A longer training or larger images give finer detail.",
                (f"g0.steps={2 * self._figure('g0', 'steps')}", f"ingest.max_size={size}"),
            )
        spread = self._figure("g0", "exposure_spread") or 0.0
        if spread > self._setting("g0", "exposure_threshold") and not self._figure("g0", "exposure"):
            yield Caution(
                f"Exposure differs by {100 * spread:.0f} % between frames",
                "Without compensation the scene averages the exposures, which causes floating haze.",
                ("g0.exposure=auto",),
            )
        for stage in ("rivr", "consolidate"):
            if harm := self._figure(stage, "held_back", "harm"):
                yield Caution(
                    f"The scene of {stage} was rejected",
                    f"It matches frames without repairs worse than the scene before ({harm}), which is kept.",
                    ("rivr.harm.psnr_margin=1.0", f"{stage}.distil.pseudo_share=0.4"),
                )
        rounds = self._figure("rivr", "rounds") or []
        refused = sum(found["repairs_refused"] for found in rounds)
        made = sum(sum(found["chosen"].values()) for found in rounds)
        if made and 2 * refused > made:
            yield Caution(
                f"{refused} of {made} repairs were refused",
                "They agree neither with the frame nor with the render: the repair model does not suit this "
                "capture. `cleargs models list` shows other models.",
                ("rivr.expert=NAME",),
            )
