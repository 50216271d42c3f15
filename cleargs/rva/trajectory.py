"""The trajectory cut into bins of equal camera motion, and how central a frame is in its bin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cleargs.rva.config import RvaConfig
from cleargs.rva.geometry import largest_distance, view_angle
from cleargs.rva.scores import Floats


@dataclass(frozen=True)
class Bins:
    """Where each frame lies on the trajectory."""

    index: npt.NDArray[np.int32]  # [N] bin of each frame
    centrality: Floats  # [N] Z in [0, 1], 1 at the middle of the bin
    edges: Floats  # [M + 1] cumulative motion at the bins' borders


def cumulative_motion(
    centres: Floats,  # [N, 3] in trajectory order
    directions: Floats,  # [N, 3] unit vectors
    config: RvaConfig,
) -> Floats:  # s [N], from 0
    """Pose motion up to each frame: a step is gamma_c (normalised centre distance) + gamma_v (view angle /
    pi).

    Centre distances are divided by the largest pairwise one of the capture, as in the pose diversity.
    """
    if not len(centres):
        return np.zeros(0)
    distance = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    scale = largest_distance(centres)
    if scale > 0.0:
        distance = distance / scale
    angle = view_angle(np.linalg.norm(np.diff(directions, axis=0), axis=1))
    return np.concatenate([[0.0], np.cumsum(config.gamma_c * distance + config.gamma_v * angle)])


def cut_into_bins(motion: Floats, frames_per_bin: int) -> Bins:  # [N] cumulative, in trajectory order
    """M = max(1, round(N / frames_per_bin)) bins of equal motion.

    With x = M s / S: bin = min(floor(x), M - 1) and Z = 1 - |2 (x - bin) - 1|. A camera that does not move
    (S = 0) has one bin with Z = 1.
    """
    total = float(motion[-1]) if len(motion) else 0.0
    if total == 0.0:
        return Bins(np.zeros(len(motion), dtype=np.int32), np.ones(len(motion)), np.zeros(2))
    count = max(1, round(len(motion) / frames_per_bin))
    position = count * motion / total
    index = np.minimum(np.floor(position), count - 1).astype(np.int32)
    centrality = np.clip(1.0 - np.abs(2.0 * (position - index) - 1.0), 0.0, 1.0)  # rounding at the borders
    return Bins(index, centrality, total * np.arange(count + 1) / count)
