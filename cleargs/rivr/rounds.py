"""One round of RIVR: restore every target frame, score its candidates, choose one, store them in an EXR.

The EXR holds the candidates and, as an attribute, the frame's row of the selection table. It is written
atomically, so an interrupted round resumes at the first frame without an EXR.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from cleargs.errors import StoreError
from cleargs.files import remove
from cleargs.formation.frame import described
from cleargs.media.exr import LayeredImage, from_layer, read_exr, to_layer, write_exr
from cleargs.models.expert import Expert
from cleargs.models.scorer import Scorer
from cleargs.progress import Reporter
from cleargs.rivr.candidates import (
    OBSERVED,
    Materials,
    Source,
    candidate,
    decide,
    hide_masked,
    is_negligible_change,
    made_image,
)
from cleargs.rivr.config import RepairConfig
from cleargs.rivr.gates import rejection_reason
from cleargs.rivr.tables import Selection, chosen_counts
from cleargs.scene.viewer import Deblurred, SceneViewer, observed_image
from cleargs.splat.views import TrainingView
from cleargs.types import ImageF32, MaskBool

ROW = "cleargs:row"
"""Attribute of the EXR with the frame's row of the selection table, as JSON."""

TRUSTED = 0.5
"""Minimum weight of a frame that image formation explains and that supervises without a repair."""


@dataclass(frozen=True)
class RepairContext:
    """Settings, expert and scorers of the repairs."""

    config: RepairConfig
    expert: Expert
    primary: Scorer
    tiebreak: Scorer
    cache: Path
    """Folder for the restorations of frame images, each of which is made when it is first needed."""
    threads: int

    def restored(
        self, view: TrainingView, render: ImageF32, scene: SceneViewer
    ) -> tuple[ImageF32, Source, Deblurred | None]:
        """Restore a frame, after undoing the motion that ``scene`` has found in it. ``render`` is its R_t.

        Returns:
            The restored image, its source, and the deblurred frame (None if the source is another).
        """
        if not self.config.use_observation:
            return self._restored(render), "render", None
        deblurred = scene.deblur(view) if self.config.undo_motion else None
        if deblurred is None:
            return self._restored_observed(view), "observed", None
        return self._restored(deblurred.image), "deblurred", deblurred

    def _restored(self, image: ImageF32) -> ImageF32:
        restored = self.expert.restore(image, threads=self.threads)
        return made_image(restored, image, f"the expert {self.expert.name}")

    def _restored_observed(self, view: TrainingView) -> ImageF32:
        """Return D_t of a frame image from the cache: all rounds and resumed runs have the same bits."""
        path = self.cache / f"{view.frame_id:06d}.exr"
        try:
            return from_layer(read_exr(path).layers["restored"])
        except StoreError:  # missing or incomplete
            self.cache.mkdir(exist_ok=True)
            restored = to_layer(self._restored(observed_image(view)[0]))
            write_exr(path, LayeredImage({"restored": restored}, {}))
            return from_layer(read_exr(path).layers["restored"])


def run_round(
    number: int,
    targets: Sequence[TrainingView],
    scene: SceneViewer,
    context: RepairContext,
    out: Path,
    reporter: Reporter,
    label: str,
) -> list[Selection]:
    """Repair every target frame with the renders of ``scene``. EXRs are stored in ``out/round_NN/``.

    Frames with an EXR are skipped. An EXR that is damaged, or of another frame or round, is replaced, with a
    warning.
    """
    folder = f"round_{number:02d}"
    (out / folder).mkdir(exist_ok=True)
    rows = []
    with reporter.task(label, total=len(targets)) as task:
        for view in targets:
            exr = f"{folder}/{view.frame_id:06d}.exr"
            row = read_row(out, exr)
            if row is None or (row.round, row.frame_id) != (number, view.frame_id):
                if (out / exr).exists():
                    reporter.warn(f"{exr}: what an earlier run left cannot be used and is replaced")
                row, image = repair(number, view, exr, scene, context)
                write_exr(out / exr, image, shown=row.chosen)
            rows.append(row)
            kept = chosen_counts(rows)[OBSERVED]
            task.update(done=len(rows), note=f"{kept} kept as filmed, {len(rows) - kept} repaired")
    return rows


def repair(
    number: int, view: TrainingView, exr: str, scene: SceneViewer, context: RepairContext
) -> tuple[Selection, LayeredImage]:
    """Make, score and choose the candidates of one frame.

    All work is on the images as read back from the EXR (half floats, scene-linear), so that a resumed run has
    the images that were scored.
    """
    rendered = scene.render(view)
    restored, source, deblurred = context.restored(view, rendered, scene)
    explained = scene.explained(view)
    observed, mask = observed_image(view)
    mask = scene.static_mask(view, mask)  # regions that move are not repaired
    layers = {"render": to_layer(rendered), "restored": to_layer(restored)}
    config, threads = context.config, context.threads
    stored = (from_layer(layers["render"]), from_layer(layers["restored"]))
    materials = Materials(*stored, observed, config.fuse_sigma)
    for name in config.candidates:
        made = made_image(candidate(name).make(materials), rendered, f"the candidate {name}")
        layers[name] = to_layer(made)
    shown = {name: hide_masked(from_layer(layer), observed, mask) for name, layer in layers.items()}
    judged = shown | ({OBSERVED: observed} if config.keep_raw else {})
    primary, tiebreak = (
        {name: _score(scorer, image, threads) for name, image in judged.items()}
        for scorer in (context.primary, context.tiebreak)
    )
    decision = decide(
        primary,
        tiebreak,
        config.margin,
        masked=mask is not None and not mask.any(),
        explained=described(explained.formation) if explained and explained.weight >= TRUSTED else None,
        # A frame of weight 0 supervises only by its repair.
        negligible=view.weight > 0.0 and is_negligible_change(observed, shown["restored"], shown["render"]),
        refused=rejection_reason(shown["restored"], observed, shown["render"], config.gate),
    )
    row = Selection(
        round=number,
        frame_id=view.frame_id,
        exr=exr,
        primary_metric=context.primary.name,
        primary=primary,
        tiebreak_metric=context.tiebreak.name,
        tiebreak=tiebreak,
        restored_from=source,
        blur_px=None if deblurred is None else float(np.float32(deblurred.formation.blur_px)),
        skew_px=None if deblurred is None else float(np.float32(deblurred.formation.skew_px)),
        **asdict(decision),
    )
    layers[OBSERVED] = to_layer(observed)
    if deblurred is not None:
        layers["deblurred"] = to_layer(deblurred.image)
    if explained is not None:
        layers["explained"] = to_layer(explained.image)
    return row, LayeredImage(layers, {ROW: json.dumps(asdict(row))})


def forget_other_frames(out: Path, rounds: int, targets: Sequence[TrainingView]) -> None:
    """Remove files that do not belong to the EXRs of ``targets`` in rounds 1 to ``rounds``."""
    ours = {
        f"round_{number:02d}/{view.frame_id:06d}.exr" for number in range(1, rounds + 1) for view in targets
    }
    for place in out.glob("round_*/*"):
        if place.relative_to(out).as_posix() not in ours:
            remove(place)


def read_row(out: Path, exr: str) -> Selection | None:
    """Return the row in the attributes of the EXR at ``out/exr``; None where there is no complete EXR."""
    if not (out / exr).exists():
        return None
    try:
        return Selection(**json.loads(str(read_exr(out / exr, ROW).attributes[ROW])))
    except (StoreError, KeyError, TypeError, ValueError):
        return None


def pseudo_view(target: TrainingView, row: Selection, out: Path) -> TrainingView:
    """Return the chosen candidate of ``row`` as supervision at the frame's pose, masked like the frame."""

    @cache  # a training loads a view often; the mask comes with the frame image, which is then decoded once
    def mask() -> MaskBool | None:
        return target.load()[1]

    assert row.exr is not None  # every accepted row has one
    exr = out / row.exr

    def load() -> tuple[ImageF32, MaskBool | None]:
        return from_layer(read_exr(exr).layers[row.chosen]), mask()

    return replace(target, weight=1.0, kind="pseudo", load=load)


def _score(scorer: Scorer, image: ImageF32, threads: int) -> float:
    """Return the score in single precision, as stored in the EXR."""
    return float(np.float32(scorer.score(image, threads=threads)))
