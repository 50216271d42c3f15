"""Measured motion of a camera against the true one of a room that `cleargs synth --video` writes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from cleargs.capture.tables import load_frames
from cleargs.errors import InputError
from cleargs.formation.measured import load_paths
from cleargs.formation.motion import TWIST, grid_basis
from cleargs.scene.views import camera_of
from cleargs.types import ArrayF64

GRID = (9, 16)
"""Rows and columns of the image points whose motion is compared."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Motion of the image in the measured frames of a run, px per frame of the video."""

    times: ArrayF64  # [N] s
    true: ArrayF64  # [N, P, 2] at points of the image, at the median depth
    measured: ArrayF64  # [N, P, 2]
    chosen: ArrayF64  # [N, P, 2] by the chosen frames before and after
    video_times: ArrayF64  # [V] s
    video_true: ArrayF64  # [V, P, 2] in all frames of the video
    readout: tuple[float, float]
    """True and found readout time, in frames of the video; 0 where none was found."""

    def row(self) -> dict[str, float]:
        """Return the figures: mean motion, px, and the share of it that measurements leave."""
        true = _lengths(self.true).mean()
        return {
            "frames": len(self.times),
            "true_px": true,
            "left_by_neighbours": _lengths(self.measured - self.true).mean() / true,
            "left_by_chosen_frames": _lengths(self.chosen - self.true).mean() / true,
            "readout_true": self.readout[0],
            "readout_found": self.readout[1],
        }


def compare(capture: Path, run: Path) -> Comparison:
    """Compare the motions of ``run`` with the truth of ``capture``, from whose video its frames are.

    Raises InputError if the capture has no true motion, or the run no measured one.
    """
    table = capture / "truth" / "motion.parquet"
    if not table.is_file():
        raise InputError(f"{capture} has no true motion", hint="make it with cleargs synth --video")
    truth = pq.read_table(table).to_pylist()
    frame_s = truth[1]["time_s"] - truth[0]["time_s"]
    paths = load_paths(run / "ingest")
    frames = [frame for frame in load_frames(run / "ingest") if frame.registered]
    numbers = {frame.frame_id: _number(frame.name) for frame in frames}
    cameras = {frame.frame_id: camera_of(frame) for frame in frames}
    poses = {key: camera.world_to_camera for key, camera in cameras.items()}
    known = [key for key in sorted(paths) if key - 1 in poses and key + 1 in poses]
    if not known:
        raise InputError(f"{run} has no measured motion", hint="run it on the video of the capture")
    theirs = np.stack([_centre(np.reshape(truth[numbers[key]]["world_to_camera"], (3, 4))) for key in poses])
    ours = np.stack([_centre(pose[:3]) for pose in poses.values()])
    scale = _spread(ours) / _spread(theirs)
    camera = cameras[known[0]]
    basis = grid_basis(camera, GRID).reshape(TWIST, 2, -1)

    def flow(twist: ArrayF64, key: int) -> ArrayF64:  # [P, 2] px per frame of the video
        pixels = twist * camera.fx * np.array([1.0 / paths[key].depth] * 3 + [1.0] * 3)
        return np.asarray(np.einsum("t,tcp->pc", frame_s * pixels, basis))

    units = np.array([scale] * 3 + [1.0] * 3)
    near = {n: min(known, key=lambda key: abs(numbers[key] - n)) for n in range(len(truth))}
    return Comparison(
        np.array([truth[numbers[key]]["time_s"] for key in known]),
        np.stack([flow(np.array(truth[numbers[key]]["twist"]) * units, key) for key in known]),
        np.stack([flow(paths[key].path[0] * paths[key].frame_s / frame_s, key) for key in known]),
        np.stack(
            [
                flow(
                    _between(poses[key - 1], poses[key + 1])
                    / (numbers[key + 1] - numbers[key - 1])
                    / frame_s,
                    key,
                )
                for key in known
            ]
        ),
        np.array([row["time_s"] for row in truth]),
        np.stack([flow(np.array(row["twist"]) * units, near[n]) for n, row in enumerate(truth)]),
        (truth[0]["readout_s"] / frame_s, paths[known[0]].readout_s / paths[known[0]].frame_s),
    )


def plot(found: Comparison, path: Path) -> None:
    """Draw the mean horizontal and vertical motion over time into ``path``."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 1, figsize=(9, 5), sharex=True, constrained_layout=True)
    for axis, name, side in zip(axes, ("horizontal", "vertical"), (0, 1), strict=True):
        axis.plot(found.video_times, found.video_true.mean(axis=1)[:, side], color="0.6", label="true")
        axis.plot(
            found.times, found.chosen.mean(axis=1)[:, side], "x--", color="C1", label="from the chosen frames"
        )
        axis.plot(
            found.times, found.measured.mean(axis=1)[:, side], "o", color="C0", label="from the neighbours"
        )
        axis.set_ylabel(f"{name}, px per frame")
    axes[1].set_xlabel("time, s")
    axes[0].legend(loc="upper left", ncols=3, frameon=False)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    pyplot.close(figure)


def _lengths(motion: ArrayF64) -> ArrayF64:
    return np.asarray(np.hypot(motion[..., 0], motion[..., 1]))


def _number(name: str) -> int:
    """Return the number of a frame in its video, by its name."""
    return int(re.findall(r"\d+", Path(name).stem)[-1])


def _centre(pose: ArrayF64) -> ArrayF64:  # [3, 4] -> [3]
    return np.asarray(-pose[:, :3].T @ pose[:, 3])


def _spread(centres: ArrayF64) -> float:
    return float(np.linalg.norm(centres - centres.mean(axis=0)))


def _between(before: ArrayF64, after: ArrayF64) -> ArrayF64:  # [4, 4] each -> [6]
    """Return the twist from one pose, world to camera, to another."""
    from scipy.spatial.transform import Rotation

    moved = after @ np.linalg.inv(before)
    return np.concatenate([moved[:3, 3], Rotation.from_matrix(moved[:3, :3]).as_rotvec()])
