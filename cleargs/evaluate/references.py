"""References of an evaluation: sharp images, and their cameras in the scene's world."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from cleargs.capture.cameras import Intrinsics as Lens
from cleargs.capture.cameras import Pose, Similarity
from cleargs.capture.capture import SourceFrame
from cleargs.capture.cutouts import are_cut_outs, over_white
from cleargs.capture.folders import chosen, name_below_images, natural_key
from cleargs.capture.layouts.transforms import read_transforms
from cleargs.capture.prepare import is_as_stored, read_image, read_stencil
from cleargs.capture.summary import IngestSummary
from cleargs.capture.tables import Frame, load_frames, load_points
from cleargs.capture.undistort import Undistorter, undistorter
from cleargs.digest import tree_digest
from cleargs.errors import InputError, StoreError
from cleargs.evaluate.eval_report import Alignment, PosesFrom
from cleargs.evaluate.refinement import rotation_between
from cleargs.formation.measured import MeasuredPath, load_paths
from cleargs.manifest import linked_manifest
from cleargs.media import IMAGE_SUFFIXES
from cleargs.media.image import read_transparency
from cleargs.models.tiling import MIN_SIDE
from cleargs.packed import require_images
from cleargs.progress import Reporter
from cleargs.scene.folder import SceneFolder
from cleargs.scene.views import has_alpha, view_of
from cleargs.splat.camera import Camera
from cleargs.splat.views import TrainingView
from cleargs.types import ArrayF64, ImageU8, MaskBool

T = TypeVar("T")

LARGE_RESIDUAL = 0.02
"""Residual of a fit of two worlds, as a share of the trajectory's extent, above which there is a warning."""

MAX_RESIDUAL = 0.05
"""Residual above which there is an error: each view would be rendered far from its reference."""

MAX_OUTSIDE, MIN_SPREAD = 3.0, 0.01
"""Distance of the references, in reaches of the scene, and spread of them, in that of the frames, from which
the units of both differ."""

SAME_VIEW = 0.05
"""Two views are the same if their centres are closer than this (the farthest camera is 1 from the mean), and
their angle is below this, rad. Pose noise is smaller, and the next view of a set is mostly farther."""

_ROUNDING = 1e-9  # extent of centres, relative to their coordinates, below which they count as one place
_FLAT = 1e-3  # second-largest over largest extent of centres below which they count as one line


@dataclass(frozen=True, eq=False)
class ReferenceView:
    """One image to compare with."""

    name: str
    """Stem of its file, by which it is matched."""
    camera: Camera
    """Pinhole of the image, in the scene's world."""
    load: Callable[[], tuple[ImageU8, MaskBool | None]]
    """Returns the image [H, W, 3] and its mask [H, W] (True counts; None: all do). Raises InputError."""
    depth: Path | None = None
    """EXR of the true depth, as `cleargs synth` writes it; None if it is not known."""
    unit: float = 1.0
    """Length of a unit of the scene, in the units of ``depth``."""
    path: MeasuredPath | None = None
    """Measured motion of the camera; None if none is known."""
    cut_out: bool = False
    """True if the image is a cut-out over white: renders are compared over white, empty pixels count."""

    @property
    def pose(self) -> Pose:
        """Pose of the camera in the scene's world."""
        return Pose(self.camera.world_to_camera[:3, :3], self.camera.world_to_camera[:3, 3])

    def at(self, pose: Pose) -> ReferenceView:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.translation
        return replace(self, camera=replace(self.camera, world_to_camera=matrix))


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

    If the run's poses are from SfM, or were refined, the worlds are aligned by cameras of equal stems. Raises
    InputError if files are missing or damaged, stems do not match, worlds do not align, or nothing was held
    out.
    """
    if run is None:
        if directory is None:
            raise InputError("there is nothing to compare with", hint="give --reference DIR: sharp images")
        views = list(_listed(directory).values())
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
        listed = _listed(directory)
        own = _by_stem((stem_of(frame.name), frame.pose) for frame in frames if frame.registered)
        hint = f"name the references like the frames (cleargs show {run} ingest)"
        alignment = Alignment(world="ingest", matched=len(listed.keys() & own.keys()))
        if poses == "given":
            views = [replace(listed[stem].at(own[stem]), depth=None) for stem in matching(listed, own, hint)]
            if missing := len(listed) - len(views):
                reporter.warn(f"{missing} of {len(listed)} references match no frame: left out")
            alignment = Alignment(world="scene", matched=len(views))
        else:
            ingested = IngestSummary.of(manifest)
            if ingested.poses in ("sfm", "adjusted"):
                observed = directory.parent / "observed"  # synthetic captures have it
                if align is None and (observed / "transforms.json").is_file():
                    align = observed
                known = listed if align is None else _listed(align)
                stems = matching(known, own, hint)
                theirs, ours = [known[stem].pose for stem in stems], [own[stem] for stem in stems]
                similarity, alignment = align_cameras(theirs, ours)
                _report_fit(alignment, align or directory, reporter)
            else:
                similarity = Similarity.from_json(ingested.similarity, ingest)
                theirs = [similarity.pose(view.pose) for view in listed.values()]
                _require_one_unit(theirs, [*own.values()], _points(ingest))
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


def _report_fit(alignment: Alignment, folder: Path, reporter: Reporter) -> None:
    assert alignment.residual is not None  # fitted
    text = (
        f"worlds aligned by {alignment.matched} cameras of {folder}: residual {alignment.residual:.2%} "
        f"of the trajectory's extent, orientations {alignment.rotation_deg:.2f} degrees apart"
    )
    hint = "give --align DIR with the poses of the run's own frames: equal stems may be other frames here"
    if alignment.residual > MAX_RESIDUAL:
        raise InputError(f"{text}: too large for a comparison", hint=hint)
    if alignment.residual > LARGE_RESIDUAL:
        reporter.warn(f"{text}: large; {hint}")
    else:
        reporter.info(text)


def _points(ingest: Path) -> ArrayF64:  # [P, 3]
    """Return the sparse points of a run; none if it lacks their table."""
    try:
        return load_points(ingest).xyz
    except StoreError:
        return np.zeros((0, 3))


def _require_one_unit(theirs: Sequence[Pose], ours: Sequence[Pose], points: ArrayF64) -> None:
    """Raise InputError if the references are far outside the scene, or all at one place of it.

    ``points`` [P, 3] are the scene's, in the world of both.
    """
    if not ours:
        return
    away, own = (np.stack([pose.centre for pose in poses]) for poses in (theirs, ours))
    middle = own.mean(axis=0)
    scene = np.concatenate([own, points])
    reach = float(np.quantile(np.linalg.norm(scene - middle, axis=1), 0.99))
    distance = float(np.median(np.linalg.norm(away - middle, axis=1)))
    spreads = [float(np.linalg.norm(centres.std(axis=0))) for centres in (away, own)]
    fault = ""
    if distance > MAX_OUTSIDE * reach:
        times = distance / max(reach, 1e-12)
        fault = f"the references are {times:.3g} times as far away as the scene reaches"
    elif len(away) >= 3 and spreads[0] < spreads[1] * MIN_SPREAD:
        times = spreads[1] / max(spreads[0], 1e-12)
        fault = f"the references are {times:.3g} times as close together as the frames"
    if fault:
        hint = "give their poses in the world and the units of the run's input (metres against millimetres?)"
        raise InputError(fault, hint=hint)


def align_cameras(source: Sequence[Pose], target: Sequence[Pose]) -> tuple[Similarity, Alignment]:
    """Return the similarity that maps cameras best, by position and direction, and its residuals.

    ``source`` and ``target`` are the same cameras, in the world to map from and in the world to map to.

    The centres of a handheld walk are near a line or a plane, so they fix the rotation poorly: an error of
    half a degree may remain, which costs an image decibels. Therefore the centres give only a first scale.
    Then each camera counts as four points: its centre, and one on each axis at the distance by which the
    centres spread. Raises InputError for fewer than three cameras, or for centres on one line.
    """
    theirs, ours = (np.stack([pose.centre for pose in poses]) for poses in (source, target))
    scale = umeyama(theirs, ours).scale
    spread = float(np.sqrt(ours.var(axis=0).sum()))
    fit = umeyama(_with_axes(source, theirs, spread * scale), _with_axes(target, ours, spread))
    errors = np.linalg.norm(fit.points(theirs) - ours, axis=1)
    extent = float(np.linalg.norm(ours[:, None] - ours[None], axis=2).max())
    pairs = zip(source, target, strict=True)
    angles = [rotation_between(fit.pose(their).rotation, our.rotation) for their, our in pairs]
    return fit, Alignment(
        world="umeyama",
        matched=len(source),
        residual=float(np.sqrt((errors**2).mean())) / extent,
        rotation_deg=float(np.mean(angles)),
    )


def _with_axes(poses: Sequence[Pose], centres: ArrayF64, length: float) -> ArrayF64:  # [4 N, 3]
    axes = np.stack([pose.rotation for pose in poses])  # rows: the camera's axes in the world
    return np.concatenate([centres, (centres[:, None] + length * axes).reshape(-1, 3)])


def umeyama(source: ArrayF64, target: ArrayF64) -> Similarity:
    """Return the least-squares similarity from ``source`` to ``target`` (Umeyama, PAMI 1991), in float64.

    Both are the centres [N, 3] of the same cameras. Raises InputError for fewer than three centres, or for
    centres on one line.
    """
    hint = "give at least three references, taken at places that are not on one line"
    if len(source) < 3:
        raise InputError(f"{len(source)} matched frames cannot align two worlds", hint=hint)
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    for places, centred in ((source, a), (target, b)):
        spread = np.linalg.svd(centred, compute_uv=False)
        if spread[0] <= _ROUNDING * np.abs(places).max() or spread[1] <= _FLAT * spread[0]:
            what = "the matched cameras are at one place or on one line, which fixes no turn about it"
            raise InputError(what, hint=hint)
    u, stretch, vt = np.linalg.svd(np.einsum("ni,nj->ij", b, a) / len(a))
    mirror = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * mirror) @ vt
    scale = float((stretch * mirror).sum() / ((a * a).sum() / len(a)))
    # `Similarity` divides by its scale: x_target = rotation (x_source - origin) / (1 / scale).
    return Similarity(rotation, source_mean - rotation.T @ target_mean / scale, 1.0 / scale)


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
        load = partial(_cut_out, view) if cut_out else view.load
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


def _listed(directory: Path) -> dict[str, ReferenceView]:
    """Return the views of a folder with ``transforms.json``, by stem, in the folder's world."""
    path = directory / "transforms.json"
    if not path.is_file():
        raise InputError(
            f"{directory} is not a reference: it has no transforms.json",
            hint="give a folder with images/ and transforms.json in the world of the run's input",
        )
    entries = read_transforms(path, poses=True)
    if not entries:
        raise InputError(f"{path} lists no frames", hint="list at least one image with its pose")
    names = [name_below_images(entry.name) for entry in entries]
    way_of = cache(partial(undistorter, max_size=sys.maxsize))
    views, found = [], chosen(entries, directory / "images", len(entries), names)
    cut_out = are_cut_outs([entry.path for entry in found])
    for entry in found:
        lens, pose = entry.camera, entry.pose
        assert lens is not None and pose is not None  # asked for with poses=True
        way = way_of(lens)
        flat = way.pinhole
        camera = Camera(flat.width, flat.height, *flat.focal, *flat.centre, np.eye(4))
        stem = stem_of(entry.name)
        depth = directory / "depth" / f"{stem}.exr"
        known = depth if lens.is_pinhole and depth.is_file() else None
        load = partial(_load, entry, lens, way, cut_out)
        view = ReferenceView(stem, camera, load, known, cut_out=cut_out)
        views.append((stem, view.at(pose)))
    return _by_stem(views)


def _cut_out(view: TrainingView) -> tuple[ImageU8, MaskBool | None]:
    """Return a cut-out of a run over white, and its mask, in which empty pixels count."""
    image, mask = view.load()
    alpha = None if view.transparency is None else view.transparency()
    assert alpha is not None and image.dtype == np.uint8
    return over_white(image, alpha), None if mask is None else mask | (alpha <= 127)


def _load(frame: SourceFrame, lens: Lens, way: Undistorter, cut_out: bool) -> tuple[ImageU8, MaskBool | None]:
    image = read_image(frame)
    stencil = None if cut_out and frame.mask is None else read_stencil(frame)
    if cut_out:
        alpha = read_transparency(frame.path, upright=not is_as_stored(frame))
        assert alpha is not None  # `are_cut_outs`
        image = over_white(image, alpha)
    if image.shape[1::-1] != (lens.width, lens.height):
        raise InputError(
            f"{frame.path} has {image.shape[1]}x{image.shape[0]} pixels, "
            f"its camera {lens.width}x{lens.height}",
            hint="give the images at the size that transforms.json states (w, h)",
        )
    if stencil is not None and stencil.shape != image.shape[:2]:
        raise InputError(
            f"the mask {frame.mask} has {stencil.shape[1]}x{stencil.shape[0]} pixels, "
            f"its image {lens.width}x{lens.height}",
            hint="make masks of the size of their images",
        )
    image, stencil = way.image(image), None if stencil is None else way.mask(stencil)
    if min(image.shape[:2]) < MIN_SIDE:
        raise InputError(
            f"{frame.path} has {image.shape[1]}x{image.shape[0]} pixels: too small to be compared",
            hint=f"give references of at least {MIN_SIDE} pixels on each side",
        )
    return image, None if stencil is None else stencil > 0


def stem_of(name: str) -> str:
    """Return a file's name without folder and image ending; the name of a video's frame may have dots."""
    path = Path(name)
    return path.stem if path.suffix.lower() in IMAGE_SUFFIXES else path.name


def _by_stem(items: Iterable[tuple[str, T]]) -> dict[str, T]:
    found: dict[str, T] = {}
    for stem, item in items:
        if stem in found:
            raise InputError(
                f"two images are called {stem}: their stems do not distinguish them",
                hint="give each image a different name",
            )
        found[stem] = item
    return found
