"""References of an evaluation: sharp images, and their cameras in the scene's world."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from cleargs.capture.cameras import Similarity
from cleargs.capture.folders import natural_key
from cleargs.capture.summary import IngestSummary
from cleargs.capture.tables import Frame, load_frames, load_points
from cleargs.digest import tree_digest
from cleargs.errors import InputError, StoreError
from cleargs.evaluate.alignment import align_cameras, report_fit, require_one_unit
from cleargs.evaluate.eval_report import Alignment, PosesFrom
from cleargs.evaluate.reference_views import ReferenceView, by_stem, cut_out_image, listed_views, stem_of
from cleargs.evaluate.refinement import rotation_between
from cleargs.formation.measured import load_paths
from cleargs.manifest import linked_manifest
from cleargs.packed import require_images
from cleargs.progress import Reporter
from cleargs.scene.folder import SceneFolder
from cleargs.scene.views import has_alpha, view_of
from cleargs.types import ArrayF64

SAME_VIEW = 0.05
"""Two views are the same if their centres are closer than this (the farthest camera is 1 from the mean), and
their angle is below this, rad. Pose noise is smaller, and the next view of a set is mostly farther."""


@dataclass(frozen=True, eq=False)
class Reference:
    """All images to compare with, by name in natural order."""

    name: str
    views: tuple[ReferenceView, ...]
    poses: PosesFrom
    alignment: Alignment
    points: ArrayF64 | None = None
    """The run's sparse points [P, 3], in the scene's world; None without a run."""


def reference_of(
    run: Path | None,  # None: the scene is in the world of ``directory``
    directory: Path | None,  # has ``images/`` and ``transforms.json``; None: frames that the run held out
    *,
    poses: PosesFrom = "reference",  # or those of the run, of the frames of the same stems
    align: Path | None = None,  # cameras that align the worlds; None: ``observed`` next to, or ``directory``
    reporter: Reporter,
) -> Reference:
    """Return the reference for the scenes of a run, or for a scene in the world of ``directory``.

    Raises InputError if files are missing or damaged, stems do not match, worlds do not align, or nothing was
    held out.
    """
    if run is None:
        if directory is None:
            raise InputError("there is nothing to compare with", hint="give --reference DIR: sharp images")
        views = list(listed_views(directory).values())
        return _reference(directory.resolve().name, views, "reference", Alignment(world="scene", matched=0))
    ingest = run / "ingest"
    manifest = linked_manifest(run, "ingest")
    if manifest is None:
        raise InputError(
            f"{run} has no finished ingest: nothing is known of its world", hint=f"see cleargs status {run}"
        )
    frames = load_frames(ingest)
    if directory is None:
        require_images(run, "a comparison with held-out frames")
        found = _held_out(ingest, frames)
    else:
        listed = listed_views(directory)
        own = by_stem((stem_of(frame.name), frame.pose) for frame in frames if frame.registered)
        hint = f"name the references like the frames (cleargs show {run} ingest)"
        alignment = Alignment(world="ingest", matched=len(listed.keys() & own.keys()))
        if poses == "given":
            views = [replace(listed[stem].at(own[stem]), depth=None) for stem in matching(listed, own, hint)]
            if missing := len(listed) - len(views):
                reporter.warn(f"{missing} of {len(listed)} references match no frame: left out")
            alignment = Alignment(world="scene", matched=len(views))
        else:
            if IngestSummary.of(manifest).poses in ("sfm", "adjusted"):
                observed = directory.parent / "observed"  # synthetic captures have it
                if align is None and (observed / "transforms.json").is_file():
                    align = observed
                known = listed if align is None else listed_views(align)
                stems = matching(known, own, hint)
                theirs, ours = [known[stem].pose for stem in stems], [own[stem] for stem in stems]
                similarity, alignment = align_cameras(theirs, ours)
                report_fit(alignment, align or directory, reporter)
            else:
                similarity = Similarity.read(ingest)
                theirs = [similarity.pose(view.pose) for view in listed.values()]
                require_one_unit(theirs, [*own.values()], _points(ingest))
            views = [
                replace(view.at(similarity.pose(view.pose)), unit=similarity.scale)
                for view in listed.values()
            ]
        found = _reference(directory.resolve().name, views, poses, alignment)
    try:
        return replace(found, points=load_points(ingest).xyz)
    except StoreError:  # without points, there are no figures of the far region
        return found


def matching(found: Iterable[str], wanted: Iterable[str], hint: str) -> list[str]:
    """Return the stems in both ``found`` and ``wanted``. Raises InputError if there is none."""
    stems = sorted({*found} & {*wanted}, key=natural_key)
    if not stems:
        raise InputError(
            f"no stem matches: there are {_examples(found)} against {_examples(wanted)}", hint=hint
        )
    return stems


def _examples(stems: Iterable[str]) -> str:
    names = sorted(stems, key=natural_key)
    return f"{', '.join(names[:2]) or 'none'}{f' ... ({len(names)} in all)' if len(names) > 2 else ''}"


def _reference(
    name: str, views: Iterable[ReferenceView], poses: PosesFrom, alignment: Alignment
) -> Reference:
    ordered = sorted(views, key=lambda view: natural_key(view.name))
    return Reference(name, tuple(ordered), poses, alignment)


def _points(ingest: Path) -> ArrayF64:  # [P, 3]
    """Return the sparse points of a run; none if it lacks their table."""
    try:
        return load_points(ingest).xyz
    except StoreError:
        return np.zeros((0, 3))


def _held_out(ingest: Path, frames: list[Frame]) -> Reference:
    test = [frame for frame in frames if frame.split == "test" and frame.registered]
    if not test:
        raise InputError(
            "the run held no frames out: there is nothing to compare with",
            hint="give --reference DIR, or run it again with --set ingest.holdout=every:8",
        )
    views = []
    measured = load_paths(ingest)
    stems = Counter(stem_of(frame.name) for frame in test)
    for frame in test:
        stem = stem_of(frame.name)
        if stems[stem] > 1:  # for example the cameras of a rig, in separate folders
            stem = f"{frame.frame_id:06d}-{stem}"
        view = view_of(frame, ingest, 1.0)
        path, cut_out = measured.get(frame.frame_id), has_alpha(ingest / frame.image)
        load = partial(cut_out_image, view) if cut_out else view.load
        views.append(ReferenceView(stem, view.camera, load, path=path, cut_out=cut_out))
    return _reference("holdout", views, "given", Alignment(world="scene", matched=len(views)))


def views_trained_on(run: Path, stage: str, reference: Reference) -> int | None:
    """Return the number of views of ``reference`` that show frames of the training of ``stage``.

    Such a view has the stem and about the pose of a frame. The frames are the rows of the scene's exposure
    table. None if RUN/ingest no longer has the images of the training.
    """
    made, ingest = linked_manifest(run, stage), linked_manifest(run, "ingest")
    if made is None or ingest is None:
        return None
    if made.parts.inputs.get("ingest", {}).get("images") != tree_digest(ingest.under("images")):
        return None
    try:
        trained = {int(number) for number in SceneFolder(run / stage).exposure().frame_ids}
    except StoreError:
        return None
    own = {stem_of(frame.name): frame for frame in load_frames(run / "ingest") if frame.frame_id in trained}
    count = 0
    for view in reference.views:
        if view.name in own:
            there, pose = view.pose, own[view.name].pose
            apart = rotation_between(there.rotation, pose.rotation)
            if np.linalg.norm(there.centre - pose.centre) < SAME_VIEW and apart < np.degrees(SAME_VIEW):
                count += 1
    return count
