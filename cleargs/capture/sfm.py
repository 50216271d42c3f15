"""Poses, cameras and sparse points of a capture.

A capture without poses gets them by structure from motion. Given poses are triangulated. Poses and cameras
that the images contradict are adjusted or found again: mostly those of depth cameras and headsets. COLMAP
itself runs in `cleargs.capture.sfm_worker`, a child process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from cleargs.capture import known_models
from cleargs.capture.camera_models import FIRST_LENS, SfmModel
from cleargs.capture.cameras import (
    COLMAPS_GUESS,
    Intrinsics,
    Pose,
    Similarity,
    guessed_camera,
    normalise,
    upright,
)
from cleargs.capture.child import run_child
from cleargs.capture.config import SfmConfig
from cleargs.capture.database import is_sound, remove_database
from cleargs.capture.lens_report import report_lens
from cleargs.capture.model import ModelImage, SparseModel, read_model
from cleargs.capture.prepare import WorkFrame
from cleargs.capture.sfm_job import (
    GOOD_SHARE,
    HALVES_APART,
    LEAST_SHARE,
    LITTLE_DEPTH,
    MIN_KEYPOINTS,
    MOVE,
    MUCH_MOTION,
    NO_DEPTH,
    OUTCOME,
    OWN,
    SECOND_MOTION,
    STILL_SHARE,
    STRANGE_SHARE,
    Job,
    SfmOutcome,
)
from cleargs.capture.upright import find_up, stated_ups
from cleargs.errors import InputError, StageError
from cleargs.files import remove, write_json
from cleargs.media.image import image_size, lens_name, stated_focal
from cleargs.media.video import video_size
from cleargs.progress import Reporter
from cleargs.safe_io import faults_as, read_json

FARTHEST = 1e9
"""Largest coordinate of a point in the normalised world, where the farthest camera has distance 1."""

LEAST_ELSEWHERE = 0.15
"""Least share of the frames that fit each other, but not those that are placed, which is named."""

WARN_REGISTERED = 0.60
"""Below this share of frames with a pose the user is warned."""

_DOUBT = (
    "state the lens (ingest.focal, ingest.camera_model), mask what moves by itself (masks/), "
    "or record slower, with more light and texture"
)

_ADVICE = (
    "record more frames (ingest.fps, ingest.max_frames) with slower motion, "
    "try another ingest.camera_model, or raise ingest.feature_size"
)


@dataclass(frozen=True)
class Reconstruction:
    """A sparse model in the normalised world; image names are those of the working images."""

    model: SparseModel
    similarity: Similarity
    outcome: SfmOutcome
    stood: bool = False
    """True if its up is not the mean direction to the tops of the pictures (`find_up`)."""

    def with_model(self, model: SparseModel) -> tuple[Reconstruction, float]:
        """Return the reconstruction with an adjusted ``model``, and the factor by which its lengths changed.

        Found poses are normalised again. Others stay in their world.
        """
        if self.outcome.method != "sfm":
            return replace(self, model=model), 1.0
        up = np.array([0.0, -1.0, 0.0]) if self.stood else None
        again = normalise([image.pose for _, image in sorted(model.images.items())], up)
        return replace(
            self, model=model.moved(again), similarity=self.similarity.then(again)
        ), 1 / again.scale

    def turned_up(self, frames: Sequence[WorkFrame], reporter: Reporter) -> Reconstruction:
        """Return the reconstruction with up as `find_up` finds it. A guess is reported."""
        up, told = find_up(self.model, stated_ups(frames))
        if told:
            reporter.info(told)
        if up is None:
            return self
        turn = Similarity(upright(up), np.zeros(3), 1.0)
        turned = self.model.moved(turn)
        return replace(self, model=turned, similarity=self.similarity.then(turn), stood=True)


def reconstruct(
    frames: Sequence[WorkFrame],
    given: SparseModel | None,
    folder: Path,
    config: SfmConfig,
    seed: int,
    threads: int,
    reporter: Reporter,
    known: Callable[[Job], Path] | None = None,
) -> Reconstruction:
    """Return poses, cameras and points of the working images in ``folder``, in which COLMAP works too.

    ``known`` returns the file that keeps the model of a job for later runs (`known_models.file_of`).

    Poses of the input are normalised in float64 before COLMAP uses them. The sparse model ``given`` with the
    input replaces the triangulation if its poses fit the images. StageError is raised if too few frames get
    a pose.
    """
    poses = {frame.image: frame.source.pose for frame in frames if frame.source.pose is not None}
    posed = [frame for frame in frames if frame.image in poses]
    adopted: SparseModel | None = None
    stale = False
    if not posed:
        job = job_of(frames, None, folder, config, seed, threads)
        try:
            model, outcome = _found(job, reporter, known)
        except StageError as error:
            if str(error) == NO_DEPTH or not any(map(stated_focal, filter(None, job.exif_images))):
                raise
            reporter.warn(
                "with the focal length in the EXIF data of the images too few frames could be placed: "
                "it may be wrong, and is left out"
            )
            alone = folder / "without-exif"
            alone.mkdir(exist_ok=True)
            job = job.model_copy(update={"folder": alone, "exif_images": [None] * len(job.exif_images)})
            model, outcome = _found(job, reporter, known)
        if len(outcome.elsewhere) >= LEAST_ELSEWHERE * len(frames):
            named = [frame.source.name for frame in frames if frame.image in set(outcome.elsewhere)]
            reporter.warn(
                f"{len(named)} frames ({named[0]} to {named[-1]}) fit each other, but not the "
                f"{len(model.images)} frames that are placed, as after a cut to another place: "
                "give each part alone (--start and --end, or --only)"
            )
        else:
            _check_registered(len(model.images), len(frames), config, reporter, outcome)
        report_lens(model, frames, config, len(job.cameras), reporter)
        if outcome.focal_open:
            (lens,) = model.cameras.values()
            reporter.warn(
                "all frames look the same way, which leaves the focal length open: "
                f"{lens.focal[0]:.0f} px are assumed, and depths are as wrong as they are. State the focal "
                "length (ingest.focal), or film from other angles, too"
            )
        if outcome.shifts_px:
            reach = max(abs(shift) for pair in outcome.shifts_px.values() for shift in pair)
            reporter.warn(
                f"the picture moves by up to {reach:.0f} px against the lens, as in stabilised video: each "
                "frame gets its own image centre. Film without stabilisation if you can"
            )
        if outcome.torn_at is not None:
            reporter.warn(
                f"the frames before {frames[outcome.torn_at].source.name} may be at another scale: "
                "use more frames (ingest.max_frames), or leave one part out"
            )
        return _normalised(model, None, outcome)
    _check_registered(len(posed), len(frames), config, reporter, SfmOutcome())
    worlds = _conventions(list(poses.values()), others=given is None)
    world, _ = worlds[OWN]
    if given is not None:
        adopted = _within_reach(_adopted(given, posed).moved(world))
        if adopted.dropped:
            reporter.warn(
                f"{adopted.dropped} points of the input's sparse model are left out: not finite, or too far"
            )
        missed = float(np.median(adopted.error)) if len(adopted.error) else 0.0
        # Some exporters write 0 or -1 for an unknown error. A known one may be older than poses and cameras.
        misses = adopted.misses()
        stale = missed > 0 < len(misses) and bool(np.median(misses) > max(2 * missed, config.refine_above))
        if 0 < missed <= config.refine_above and not stale:
            return Reconstruction(adopted, world, SfmOutcome(placed=_placed(frames, {}), missed_px=missed))
    readings = {name: [world.pose(pose) for pose in read] for name, (world, read) in worlds.items()}
    model, outcome = _run(job_of(posed, readings, folder, config, seed, threads), reporter, known)
    if not len(model.point_ids):
        raise StageError(
            "no point could be triangulated at the given poses",
            hint="check that poses, axes (OpenGL camera to world) and images belong together, "
            "or set ingest.poses=sfm",
        )
    if outcome.convention != OWN:
        reporter.warn(
            f"the poses do not fit the images in the convention of the input: read as {outcome.convention}"
        )
    _report_outcome(outcome, float(np.median(model.error)), config, reporter)
    found = dict(outcome.placed) or dict.fromkeys(poses, "given" if outcome.method == "given" else "adjusted")
    outcome = outcome.model_copy(update={"placed": _placed(frames, found)})
    if outcome.method == "sfm":
        return _normalised(model, worlds[outcome.convention][0], outcome)
    if adopted is not None and len(adopted.error) and not stale and outcome.method == "given":
        model = adopted
    return Reconstruction(model, worlds[outcome.convention][0], outcome)


def contradictions(
    outcome: SfmOutcome, config: SfmConfig, reporter: Reporter, *, rolled: bool = False
) -> tuple[str, ...]:
    """Report the errors of the cameras at the kept-out keypoints. Return a line if these contradict them.

    Halves of the pictures that disagree are a warning, unless the shutter is known to roll (``rolled``).
    Raises StageError if found cameras are so wrong that no scene is possible. Poses of the input that
    ``config.refine_above`` keeps give a warning only.
    """
    apart = outcome.halves_apart >= HALVES_APART and not rolled
    if apart:
        reporter.warn(
            f"the upper and the lower half of the pictures place the camera {outcome.halves_apart:.1%} of "
            "the size of its path apart, and its poses are about as wrong: a shutter that rolls, a part that "
            "moves by itself, or another lens. Give the video instead of pictures, mask what moves (masks/), "
            "or hold still"
        )
    found = outcome.prediction
    if found is None or found.keypoints < MIN_KEYPOINTS:
        return ()
    figure = (
        f"of {found.keypoints} keypoints that took no part in the fit, {found.share:.0%} are within 2 px of "
        f"their places (median {found.median_px:.2g} px)"
    )
    least, doubt = GOOD_SHARE, _advice(outcome, _DOUBT)
    why = ""
    if outcome.strange_lens:
        least, why = STRANGE_SHARE, ", and they ask for a lens that nobody builds"
    torn = outcome.second_motion >= (SECOND_MOTION if apart else MUCH_MOTION)
    if torn:
        least, doubt = STILL_SHARE, "mask what moves (masks/), or use more frames (ingest.max_frames)"
        why = (
            f"; in {outcome.second_motion:.0%} of the pairs of frames, many matches agree with each other, "
            "but not with the cameras: a part of the pictures moves by itself (a screen, what passes a "
            "window), or frames are in wrong places"
        )
    if found.share < LEAST_SHARE and outcome.method == "sfm":
        raise StageError(f"the cameras are wrong: {figure}{why}", hint=doubt)
    kept = outcome.method == "given" and (outcome.missed_px or 0.0) <= config.refine_above
    few = f", fewer than {least:.0%}" if found.share < least else ""
    if not few and not (torn and apart):
        reporter.info(f"cameras: {figure}")
    elif kept:
        reporter.warn(f"the poses of the input are doubtful: {figure}{why}; ingest.refine_above keeps them")
    else:
        return (f"cameras that the images confirm: {figure}{few}{why}; {doubt}",)
    return ()


def _normalised(model: SparseModel, world: Similarity | None, outcome: SfmOutcome) -> Reconstruction:
    """Return ``model``, which is in ``world``, in the normalised world of its cameras."""
    again = normalise([image.pose for _, image in sorted(model.images.items())])
    return Reconstruction(model.moved(again), again if world is None else world.then(again), outcome)


def _placed(frames: Sequence[WorkFrame], found: Mapping[str, str]) -> dict[str, str]:
    """Return image -> how it was placed. Frames that are not in ``found`` keep the pose of the input."""
    return {
        frame.image: "no pose in the input" if frame.source.pose is None else found.get(frame.image, "given")
        for frame in frames
    }


def _conventions(poses: Sequence[Pose], *, others: bool) -> dict[str, tuple[Similarity, Sequence[Pose]]]:
    """Return the poses in the input's convention and, with ``others``, in all that its author may have meant.

    The value is the similarity that normalises the world of these poses, and the poses (not normalised).
    """
    found: dict[str, tuple[Similarity, Sequence[Pose]]] = {OWN: (normalise(poses), poses)}
    if others:
        inverse = "matrices from the world to the camera"
        for name, meant in {
            "matrices with OpenCV axes (y down, z forward)": [pose.with_flipped_axes() for pose in poses],
            inverse: [pose.inverted(flip=True) for pose in poses],
            f"{inverse}, with OpenCV axes": [pose.inverted(flip=False) for pose in poses],
        }.items():
            with suppress(InputError):  # in this convention all cameras are at one place
                found[name] = normalise(meant), meant
    return found


def _report_outcome(outcome: SfmOutcome, found: float, config: SfmConfig, reporter: Reporter) -> None:
    """Report if the input's poses were adjusted, found again or kept, with the errors before and after."""
    missed = outcome.missed_px or 0.0
    if outcome.method != "given":
        before, after = outcome.errors_px["given"], outcome.errors_px[outcome.method]
        what = "poses and cameras are adjusted to the images"
        if outcome.method == "sfm":
            what = "poses and cameras are found again and aligned to the given ones"
        reporter.info(
            f"at the input's poses features missed their points by {missed:.1f} px (median): {what} "
            f"({outcome.lens}), {found:.1f} px. Matches that the fit did not use are off by "
            f"{after:.2f} px, not {before:.2f}; a larger ingest.refine_above keeps the input's poses"
        )
    elif missed > config.refine_above:
        reporter.info(
            f"at the input's poses features miss their points by {missed:.1f} px (median), which no other "
            "poses and cameras explain (a rolling shutter or blur may): they stay"
        )


def _found(
    job: Job, reporter: Reporter, known: Callable[[Job], Path] | None
) -> tuple[SparseModel, SfmOutcome]:
    """Return the model of `_run`. Raises StageError if it has too few frames."""
    model, outcome = _run(job, reporter, known)
    _require_registered(len(model.images), len(job.names), job.config, outcome)
    return model, outcome


def _advice(outcome: SfmOutcome, usual: str = _ADVICE) -> str:
    """Return what to do if frames could not be placed, or were placed wrongly."""
    return f"{LITTLE_DEPTH}. {MOVE.capitalize()}" if outcome.little_depth else usual


def _require_registered(registered: int, total: int, config: SfmConfig, outcome: SfmOutcome) -> None:
    """Raise StageError if too few frames have a pose. Few are enough only if the frames show depth."""
    few = registered < WARN_REGISTERED * total and outcome.little_depth
    if few or registered < max(3, config.min_registered * total):
        text = f"only {registered} of {total} frames could be placed in space"
        raise StageError(text, hint=_advice(outcome))


def _check_registered(
    registered: int, total: int, config: SfmConfig, reporter: Reporter, outcome: SfmOutcome
) -> None:
    _require_registered(registered, total, config, outcome)
    if registered < WARN_REGISTERED * total:
        reporter.warn(f"only {registered} of {total} frames have a pose: {_ADVICE}")


def _run(job: Job, reporter: Reporter, known: Callable[[Job], Path] | None) -> tuple[SparseModel, SfmOutcome]:
    """Run COLMAP in a child process, unless a killed or an earlier run has already made the model."""
    if (found := _resumed(job.folder, reporter)) is not None:
        return found
    kept = known(job) if known is not None else None
    taken = kept is not None and known_models.take(kept, job.folder / "model")
    if taken and (found := _resumed(job.folder, reporter)) is not None:
        reporter.info("poses and points: those of an earlier run of the same pictures")
        return found
    file = job.folder / "job.json"
    write_json(file, job.model_dump(mode="json"))
    run_child("cleargs.capture.sfm_worker", file, job.folder / "colmap.log", reporter)
    if kept is not None:
        known_models.keep(job.folder / "model", kept)
    return _read(job.folder / "model")


def job_of(
    frames: Sequence[WorkFrame],
    poses: Mapping[str, Sequence[Pose]] | None,
    folder: Path,
    config: SfmConfig,
    seed: int,
    threads: int,
) -> Job:
    """Return the job of COLMAP's process for the working images in ``folder``.

    ``poses`` is convention -> poses of all frames. If it is None, poses must be found. Then frames of one
    size and lens share a camera, or each frame has its own (`SfmConfig.shared_camera`), and an input image of
    each camera may state its focal length.
    """
    folder = folder.resolve()
    if poses is not None:
        owners: list[object] = [frame.camera for frame in frames]
    elif config.shared_camera:
        # Frames of one lens have the same video, or the same camera and focal length by EXIF.
        lenses = [f.source.path if f.source.pts is not None else lens_name(f.source.path) for f in frames]
        owners = [(frame.width, frame.height, lens) for frame, lens in zip(frames, lenses, strict=True)]
    else:
        owners = [frame.image for frame in frames]
    known_focal = {}
    if poses is None and config.focal is not None:
        size = _input_size(frames[0])
        known_focal = {kind: config.focal_share(kind, size) for kind in (FIRST_LENS, *get_args(SfmModel))}
    numbers = {owner: number for number, owner in enumerate(dict.fromkeys(owners))}
    cameras: list[Intrinsics] = []
    exif_images: list[Path | None] = []
    for frame in (frames[owners.index(owner)] for owner in numbers):
        known = frame.camera if poses is not None else None
        model = FIRST_LENS if config.camera_model == "auto" else config.camera_model
        share = known_focal.get(model, COLMAPS_GUESS)
        cameras.append(known or guessed_camera(model, frame.width, frame.height, share))
        stated = poses is None and frame.source.pts is None and config.focal is None
        exif_images.append(frame.source.path.resolve() if stated else None)
    matrices = {
        name: [np.column_stack([pose.rotation, pose.translation]).tolist() for pose in read]
        for name, read in (poses or {}).items()
    }
    return Job(
        folder=folder,
        images=folder / "images",
        masks=_masks(frames, folder),
        names=[frame.image for frame in frames],
        cameras=cameras,
        camera_of=[numbers[owner] for owner in owners],
        poses=None if poses is None else matrices,
        exif_images=exif_images,
        known_focal=known_focal,
        focal_known=bool(known_focal),
        config=SfmConfig(**config.model_dump(include=set(SfmConfig.model_fields))),
        seed=seed,
        threads=threads,
    )


def _masks(frames: Sequence[WorkFrame], folder: Path) -> Path | None:
    """Return the folder of the masks of features; None if no frame has one."""
    if any(frame.movers for frame in frames):
        return folder / "features"
    return folder / "masks" if any(frame.masked for frame in frames) else None


def _input_size(frame: WorkFrame) -> int:
    """Return the long side of the frame's image in the input, px."""
    source = frame.source
    if source.camera is not None:
        return max(source.camera.width, source.camera.height)
    return max(image_size(source.path) if source.pts is None else video_size(source.path))


def _resumed(folder: Path, reporter: Reporter) -> tuple[SparseModel, SfmOutcome] | None:
    """Return the model that a killed run left in ``folder``, or None.

    A damaged model or database is removed with a warning.
    """
    model, database = folder / "model", folder / "database.db"
    if model.exists():
        try:
            return _read(model)
        except InputError as error:
            reporter.warn(f"the damaged model of an interrupted run is computed again: {error}")
            remove(model)
    if database.exists() and not is_sound(database):
        reporter.warn("the damaged features of an interrupted run are found again")
        remove_database(database)
    return None


def _read(folder: Path) -> tuple[SparseModel, SfmOutcome]:
    """Return the model and the outcome of COLMAP's process. Raises InputError if one is damaged."""
    with faults_as(InputError, f"{OUTCOME} cannot be read", hint="run ingest again"):
        outcome = SfmOutcome.model_validate(read_json(folder / OUTCOME))
        return read_model(folder).shifted(outcome.shifts_px), outcome


def _within_reach(model: SparseModel) -> SparseModel:
    """Return the model without the points beyond `FARTHEST`, which single precision may not hold."""
    near = np.asarray((np.abs(model.xyz) < FARTHEST).all(axis=1))  # False for infinity and NaN
    return replace(model.select(near), dropped=model.dropped + int((~near).sum()))


def _adopted(given: SparseModel, frames: Sequence[WorkFrame]) -> SparseModel:
    """Return the input's model of ``frames``, with names, cameras and pixels of the working images."""
    by_name = {image.name: image for image in given.images.values()}
    cameras: dict[int, Intrinsics] = {}
    images: dict[int, ModelImage] = {}
    scale = 1.0
    for index, frame in enumerate(frames):
        original = by_name[frame.source.name]
        assert frame.camera is not None and frame.source.camera is not None
        ratio = (frame.width / frame.source.camera.width, frame.height / frame.source.camera.height)
        scale = ratio[0]
        cameras[original.camera_id] = frame.camera
        images[index + 1] = replace(original, name=frame.image, xy=original.xy * ratio)
    return replace(given, cameras=cameras, images=images, error=given.error * scale)
