"""Motion of the camera at the chosen frames, and the readout of its shutter, from the frames around them.

The neighbours of the chosen frames are decoded and tracked here. `cleargs.capture.motion_worker`, a child
process, computes motions and readout times.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cleargs.capture.capture import Capture
from cleargs.capture.child import run_child
from cleargs.capture.model import ModelImage, SparseModel, read_model, write_model
from cleargs.capture.motion import MAX_POINTS, MeasuredMotion, in_other_units, spread_out, track
from cleargs.capture.motion_job import (
    ADJUSTED,
    MOTIONS,
    OUTCOME,
    TRACKS,
    LensReadout,
    MotionJob,
    MotionOutcome,
)
from cleargs.capture.motion_table import MOTION
from cleargs.capture.neighbours import Neighbourhood, in_order, neighbourhoods, read_pictures, repeats
from cleargs.capture.prepare import WorkFrame, neighbour_file, read_image
from cleargs.capture.sfm import Reconstruction
from cleargs.files import atomic_path, make_folder, write_json
from cleargs.parquet import write_table
from cleargs.progress import Reporter
from cleargs.safe_io import read_json
from cleargs.types import ImageU8

MEASURED, TRACKED, LOST = "measured", "tracked", "too few tracks"
"""Status of a frame with a measured motion, with tracks that are not evaluated yet, with too few tracks."""
MAX_DOUBT = 0.35
"""Largest median of `MeasuredMotion.doubt` of numbered images that are frames of one video. In photographs
and in videos of which few frames were kept, the motion between two images is not that at one of them."""


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Measured motions of the frames of a capture."""

    motions: Mapping[str, MeasuredMotion]
    """By working image."""
    status: Mapping[str, str]
    """Working image -> `MEASURED`, or the reason why its motion is not measured."""
    lens_of: Mapping[str, int]
    """Working image -> number of its lens."""
    readouts: Mapping[int, LensReadout]
    """Lens -> its readout time; a lens without a rolling shutter is left out."""
    clocked: bool
    """False if times are in frames, because the capture has no clock."""

    def summary(self) -> dict[str, object]:
        """Return readout times and counts for the manifest. The first readout is that of most frames."""
        frames = Counter(self.lens_of.values())
        rows = [{"frames": count, **self._readout_of(lens)} for lens, count in frames.most_common()]
        first = {name: value for name, value in rows[0].items() if name != "frames"} if rows else {}
        several = {"readouts": rows} if len(rows) > 1 else {}
        return {**first, **several, "motion": dict(Counter(self.status.values()))}

    def _readout_of(self, lens: int) -> dict[str, object]:
        """Return the readout of a lens; null where no rolling shutter was found."""
        found = self.readouts.get(lens)
        row: dict[str, object] = {"readout_ms": None, "readout_interval_ms": None}
        if found is not None:
            unit, factor = ("ms", 1000.0) if self.clocked else ("frames", 1.0)
            row[f"readout_{unit}"] = round(factor * found.seconds, 4)
            row[f"readout_interval_{unit}"] = [round(factor * end, 4) for end in found.interval]
            row["readout_along"] = "columns" if found.columns else "rows"
            row["readout_kept_out_px"] = [round(found.still_px, 4), round(found.rolled_px, 4)]
        return row

    def report(self, reporter: Reporter, *, searched: bool) -> None:
        """Say which readout times were found, or that none was, if they were searched for."""
        if not self.motions:
            return
        factor, unit = (1000.0, "ms") if self.clocked else (1.0, "frames")
        for found in self.readouts.values():
            low, high = (f"{factor * end:.3g}" for end in found.interval)
            reporter.info(
                f"rolling shutter: {factor * found.seconds:.3g} {unit} ({low} to {high}) from the first "
                f"{'column' if found.columns else 'row'} to the last; points that the fit did not use are "
                f"off by {found.rolled_px:.2f} px, not {found.still_px:.2f}"
            )
        if searched and not self.readouts:
            reporter.info("no rolling shutter found")


def measure_motion(
    capture: Capture,
    frames: Sequence[WorkFrame],
    scene: Reconstruction,
    work: Path,
    reporter: Reporter,
    *,
    rolling_shutter: bool,
) -> tuple[Reconstruction, CameraMotion]:
    """Measure the motion of the frames with a pose, and the readout time of each lens.

    Without ``rolling_shutter`` no readout time is searched for. Poses and cameras are adjusted to the readout
    times that are found, unless they are those of the input. The tracks of a killed run in the folder
    ``work`` are used again.
    """
    model = scene.model
    status = {frame.image: "no neighbours in the input" for frame in frames}
    none = CameraMotion(
        {}, status, _lenses(frames, model, found=scene.outcome.method == "sfm"), {}, capture.has_clock
    )
    folder = work / "motion"
    status |= _follow(capture, frames, model, work, reporter)
    if TRACKED not in status.values():
        return scene, none
    write_model(folder / "start", model, np.zeros((len(model.xyz), 3), np.uint8))
    given = scene.outcome.method == "given"
    job = MotionJob(
        folder=folder,
        model=folder / "start",
        given=given,
        rolling_shutter=rolling_shutter,
        lenses=dict(none.lens_of),
    )
    write_json(folder / "job.json", job.model_dump(mode="json"))
    run_child("cleargs.capture.motion_worker", folder / "job.json", folder / "motion.log", reporter)
    motions = _read_motions(folder / MOTIONS)
    status |= {image: MEASURED if image in motions else LOST for image in status if status[image] == TRACKED}
    doubts = [motion.doubt for motion in motions.values()]
    if capture.kind != "video" and doubts and float(np.median(doubts)) > MAX_DOUBT:
        status |= dict.fromkeys(motions, "too long between the images")
        return scene, none
    readouts = {
        found.lens: found for found in MotionOutcome.model_validate(read_json(folder / OUTCOME)).readouts
    }
    if readouts:
        scene, factor = scene.with_model(read_model(folder / ADJUSTED))
        motions = {image: in_other_units(motion, factor) for image, motion in motions.items()}
    motion = replace(none, motions=motions, readouts=readouts)
    motion.report(reporter, searched=rolling_shutter)
    return scene, motion


def _follow(
    capture: Capture, frames: Sequence[WorkFrame], model: SparseModel, work: Path, reporter: Reporter
) -> dict[str, str]:
    """Track keypoints of ``model`` into the neighbours of their frames, into `TRACKS` in ``work/motion``.

    Returns the status of each working image that has neighbours.
    """
    folder = work / "motion"
    keys = {image.name: key for key, image in model.images.items()}
    around = [one for one in neighbourhoods(capture) if frames[one.number].image in keys]
    if not around:
        return {}
    make_folder(folder)
    if not (folder / TRACKS).is_file():
        arrays: dict[str, NDArray[np.generic]] = {}
        with reporter.task("following points into neighbouring frames", len(around)) as task:
            for one in around:
                name = frames[one.number].image
                shown = _pictures(one, frames[one.number], work)
                if shown is not None and not repeats(shown):
                    arrays |= _tracks(name, model.images[keys[name]], shown, one.times)
                task.advance()
        with atomic_path(folder / TRACKS) as temporary:
            np.savez(temporary, allow_pickle=False, **arrays)
    with np.load(folder / TRACKS) as stored:
        tracked = {name.removesuffix(".times") for name in stored.files if name.endswith(".times")}
    names = [frames[one.number].image for one in around]
    return {name: TRACKED if name in tracked else "repeated frames" for name in names}


def _pictures(one: Neighbourhood, frame: WorkFrame, work: Path) -> list[ImageU8] | None:
    """Return the grey pictures of ``frame`` and its neighbours in order of time, of the working image's size.

    They are None if one of them cannot be decoded. Those of a video are in the folder ``work``.
    """
    if frame.source.pts is not None:
        return read_pictures(neighbour_file(work, one.number))
    size = frame.width, frame.height
    grey = [cv2.cvtColor(read_image(source), cv2.COLOR_RGB2GRAY) for source in in_order(one, frame.source)]
    return [np.asarray(cv2.resize(one, size, interpolation=cv2.INTER_AREA), np.uint8) for one in grey]


def _lenses(frames: Sequence[WorkFrame], model: SparseModel, *, found: bool) -> dict[str, int]:
    """Return the number of the lens of each frame of ``model``: a camera in one video, or in a folder.

    If SfM gave each frame its own camera, all frames of a video or folder have the same lens: it zooms, or a
    stabiliser moves the picture.
    """
    by_name = {image.name: image.camera_id for image in model.images.values()}
    zooms = found and len(set(by_name.values())) == len(by_name)
    owners = {
        frame.image: (
            0 if zooms else by_name[frame.image],
            frame.source.path if frame.source.pts is not None else None,
        )
        for frame in frames
        if frame.image in by_name
    }
    numbers = {owner: number for number, owner in enumerate(dict.fromkeys(owners.values()))}
    return {image: numbers[owner] for image, owner in owners.items()}


def _tracks(
    name: str, image: ModelImage, shown: Sequence[ImageU8], times: Sequence[float]
) -> dict[str, NDArray[np.generic]]:
    """Return the tracks of the keypoints of ``image`` as arrays of a `MotionJob`."""
    chosen = spread_out(image.xy, MAX_POINTS)
    middle = sum(time < 0.0 for time in times)
    xy = image.xy[chosen]
    found = track(shown[middle], [*shown[:middle], *shown[middle + 1 :]], times, xy)
    return {
        f"{name}.places": np.concatenate([xy[None], found]),
        f"{name}.points": image.point_ids[chosen],
        f"{name}.times": np.array(times),
    }


def _read_motions(path: Path) -> dict[str, MeasuredMotion]:
    with np.load(path) as arrays:
        images = [name.removesuffix(".path") for name in arrays.files if name.endswith(".path")]
        motions = {}
        for image in images:
            tracks, *numbers = arrays[f"{image}.numbers"].tolist()
            derivatives, covariance = arrays[f"{image}.path"], arrays[f"{image}.covariance"]
            motions[image] = MeasuredMotion(derivatives, covariance, int(tracks), *numbers)
    return motions


def write_motion(path: Path, frames: Sequence[WorkFrame], motion: CameraMotion) -> None:
    """Write ``motion.parquet``."""
    rows = []
    for number, frame in enumerate(frames):
        measured = motion.motions.get(frame.image) if motion.status[frame.image] == MEASURED else None
        readout = motion.readouts.get(motion.lens_of.get(frame.image, -1))
        rows.append(
            {
                "frame_id": number,
                "status": motion.status[frame.image],
                "tracks": measured and measured.tracks,
                "error_px": measured and measured.error_px,
                "median_depth": measured and measured.median_depth,
                "speed_px": measured and measured.speed_px,
                "doubt": measured and measured.doubt,
                "path": measured and measured.path.ravel().tolist(),
                "covariance": measured and measured.covariance.ravel().tolist(),
                "frame_s": measured and measured.frame_s,
                "readout_s": readout and readout.seconds,
                "readout_columns": readout is not None and readout.columns,
            }
        )
    write_table(path, pa.Table.from_pylist(rows, MOTION), MOTION)
