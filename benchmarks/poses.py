"""Measure how well an adjustment and SfM correct poses and cameras with known errors.

``python -m benchmarks poses -o OUT`` prints the errors by which ingest decides which poses it takes
(docs/experiments/poses.md), and the distances of the cameras from the true ones.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cleargs.capture import sfm_worker
from cleargs.capture.adjustment import Adjuster, align_to, median_residual, set_lens
from cleargs.capture.camera_models import FULL_LENS
from cleargs.capture.cameras import Pose, normalise, pinhole
from cleargs.capture.colmap import pycolmap
from cleargs.capture.config import CaptureConfig, SfmConfig
from cleargs.capture.database import create_database
from cleargs.capture.prepare import WorkFrame, prepare
from cleargs.capture.sfm import job_of
from cleargs.capture.sfm_features import FIRST
from cleargs.capture.sfm_job import OWN
from cleargs.capture.sources import open_capture
from cleargs.progress import SilentReporter
from cleargs.synth.protocols import PROTOCOLS
from cleargs.synth.synthetic_capture import make_capture

GIVEN = {
    "exact": (0.0, 0.0, 0.0),
    "slight": (0.1, 0.003, 0.01),
    "focal": (0.0, 0.0, 0.08),
    "headset": (0.4, 0.01, 0.02),
    "depth": (0.6, 0.02, 0.13),
    "rough": (2.0, 0.06, 0.13),
    "wrong": (5.0, 0.15, 0.2),
}
"""Errors of the given cameras: standard deviation of the rotation (degrees per axis), that of the centre (per
axis, as a share of the farthest camera's distance), and relative error of the focal length."""

LENSES = {
    "pinhole": (0.0, 0.0, 0.0, 0.0),
    "radial": (0.08, 0.0, 0.0, 0.0),
    "camera": (0.08, -0.03, 0.001, -0.001),
    "wide": (0.2, -0.12, 0.004, -0.003),
}
FAULTS = ("gs2e-severe", "gsotm-rs", "gsotm-mb-rs")


FIGURES = (
    *("missed", "floor", "before", "adjusted", "sfm"),
    *("mean_adjusted", "mean_sfm"),
    *("off_before", "off_adjusted", "off_sfm", "lens_gain"),
)
"""Residual at the given poses, px; errors of matches that the fit did not use, px (medians, then means of
errors up to 4); median distances from the true cameras (shares as in `GIVEN`); gain by `FULL_LENS`."""


def rooms(folder: Path, seed: int, size: int) -> list[Path]:
    """Make a capture of a room for each of `LENSES`, and for each of `FAULTS`, which no poses explain."""
    clean = replace(PROTOCOLS["camera"], rotation_noise=0.0, translation_noise=0.0, focal_error=0.0)
    variants = {name: replace(clean, distortion=terms) for name, terms in LENSES.items()}
    found = []
    for name, protocol in {**variants, **{name: PROTOCOLS[name] for name in FAULTS}}.items():
        found.append(folder / f"{name}-{seed}")
        if not found[-1].exists():
            PROTOCOLS["measured"] = protocol
            make_capture(
                found[-1],
                "measured",
                frames=16,
                width=size,
                height=size * 3 // 4,
                seed=seed,
                reporter=SilentReporter(),
            )
    return found


def measure(capture: Path, work: Path, size: int) -> list[dict[str, str | float]]:
    """Return a row of `FIGURES` for each of `GIVEN`."""
    config = SfmConfig(max_features=700)
    frames = prepare(open_capture(capture, CaptureConfig()), work, size, SilentReporter())
    given = [frame.source.pose for frame in frames if frame.source.pose is not None]
    if given:
        assert frames[0].camera is not None
        focal = frames[0].camera.focal[0]
    else:
        frames, given, focal = _reconstructed(frames, work, config)
    world = normalise(given)
    true = [world.pose(pose) for pose in given]
    random = np.random.default_rng(0)
    rows: list[dict[str, str | float]] = []
    for name, (degrees, shift, wrong) in GIVEN.items():
        turns, moves = random.normal(size=(2, len(true), 3))
        noisy = [
            _moved(pose, np.radians(degrees) * turn, shift * move)
            for pose, turn, move in zip(true, turns, moves, strict=True)
        ]
        width, height = frames[0].width, frames[0].height
        lens = pinhole(width, height, focal * (1 + wrong), focal * (1 + wrong), width / 2, height / 2)
        sfm = _worker([replace(frame, camera=lens) for frame in frames], noisy, work, config)
        assert sfm.job.poses is not None
        start = sfm.triangulate(sfm.job.poses[OWN])
        adjuster = Adjuster(sfm.database, sfm.with_points)
        adjusted = adjuster.refine(start, cameras=True) if len(start.points3D) else None
        if name == "exact":
            found, _ = sfm.sfm_over(start, sfm.pairs(), adjuster)
            gain = np.nan if found is None else _gain(adjuster, found)
        models = (start, adjusted, found)
        errors = [np.nan if model is None else adjuster.median_error(model) for model in models]
        means = [np.nan if model is None else adjuster.mean_error(model) for model in models[1:]]
        off = [np.nan if model is None else _off(model, true) for model in models]
        figures = median_residual(start), adjuster.floor, *errors, *means, *off, gain
        rows.append({"capture": capture.name, "given": name, **dict(zip(FIGURES, figures, strict=True))})
    return rows


def _reconstructed(
    frames: Sequence[WorkFrame], work: Path, config: SfmConfig
) -> tuple[list[WorkFrame], list[Pose], float]:
    """Return the frames that SfM places, their poses, and the focal length."""
    sfm = _worker(frames, None, work, config)
    model, _ = sfm.mapped(sfm.pairs())
    by_name = {image.name: image.cam_from_world().matrix() for image in model.images.values()}
    placed = [frame for frame in frames if frame.image in by_name]
    (work / "database.db").unlink()
    matrices = [by_name[frame.image] for frame in placed]
    focal = next(iter(model.cameras.values())).mean_focal_length()
    return placed, [Pose(matrix[:, :3], matrix[:, 3]) for matrix in matrices], focal


def _worker(
    frames: Sequence[WorkFrame], poses: Sequence[Pose] | None, work: Path, config: SfmConfig
) -> sfm_worker.Sfm:
    """Return COLMAP's worker for ``frames``, with their features extracted and matched."""
    job = job_of(frames, None if poses is None else {OWN: poses}, work, config, 0, 1)
    sfm = sfm_worker.Sfm(job, lambda **_: None)
    pycolmap.set_random_seed(0)
    create_database(sfm.database, job)
    sfm.extract(sfm.database, job.names, FIRST)
    sfm.match(sfm.database, sfm.pairs())
    sfm.output.mkdir(exist_ok=True)
    return sfm


def _moved(pose: Pose, turn: NDArray[np.float64], shift: NDArray[np.float64]) -> Pose:
    rotation = Rotation.from_rotvec(turn).as_matrix() @ pose.rotation
    return Pose(rotation, -rotation @ (pose.centre + shift))


def _off(model: pycolmap.Reconstruction, true: Sequence[Pose]) -> float:
    """Return the median distance of the centres from the true ones, after an alignment; units of ``true``."""
    laid, known = copy.deepcopy(model), copy.deepcopy(model)
    for image in known.images.values():
        pose = true[image.image_id - 1]
        matrix = np.column_stack([pose.rotation, pose.translation])
        known.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d(matrix)
    align_to(laid, known, [image for image in laid.images.values() if image.has_pose])
    off = [image.projection_center() - true[image.image_id - 1].centre for image in laid.images.values()]
    return float(np.median(np.linalg.norm(off, axis=1)))


def _gain(adjuster: Adjuster, model: pycolmap.Reconstruction) -> float:
    """Return the share by which `FULL_LENS` lowers the mean error of the matches that the fit did not use."""
    simple = copy.deepcopy(model)
    set_lens(simple, "SIMPLE_RADIAL")
    simple = adjuster.adjust(simple, cameras=True)
    full = copy.deepcopy(simple)
    set_lens(full, FULL_LENS)
    full = adjuster.bundle_adjusted(full, cameras=True)
    return 1 - adjuster.mean_error(full) / adjuster.mean_error(simple)
