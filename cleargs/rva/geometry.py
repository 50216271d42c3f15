"""Geometric evidence: coverage gain C, pose diversity D, redundancy O and utility G, and trajectory bins.

Source: the paper's Geometric Evidence. The centrality Z says how close a frame is to the middle of its bin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.spatial.distance import cdist

from cleargs.rva.config import AssessmentConfig
from cleargs.types import ArrayBool, ArrayF64, ArrayInt

_PAIRS_AT_ONCE = 1 << 20  # pairs of frames in memory at a time (8 MB per float64 array)


def view_angle(chord: ArrayF64) -> ArrayF64:
    """Return the angle between unit vectors, divided by pi, from the length of their difference.

    Unlike the arccos of the dot product, this is exact at 0 and accurate for small angles.
    """
    return np.asarray(2.0 / np.pi * np.arcsin(np.clip(0.5 * chord, 0.0, 1.0)))


def largest_distance(points: ArrayF64) -> float:  # [N, 3]
    """Return the largest distance between two points; 0 for fewer than two points."""
    blocks = _row_blocks(len(points), len(points))
    return max((float(cdist(points[rows], points).max()) for rows in blocks), default=0.0)


def pose_diversity(
    centres: ArrayF64,  # [N, 3]
    directions: ArrayF64,  # [N, 3] unit vectors
    reference: ArrayBool,  # [N] the reliable set (or its replacement)
    config: AssessmentConfig,
) -> ArrayF64:  # D [N] in [0, 1]
    """Return D_i = max over reference frames j != i of gamma_c d^c_ij + gamma_v d^v_ij; 0 without such a j.

    d^c is the distance between camera centres divided by the largest one of the capture. d^v is the angle
    between view directions divided by pi.
    """
    D = np.zeros(len(centres))
    others = np.flatnonzero(reference)
    if not len(others):
        return D
    scale = largest_distance(centres)
    for rows in _row_blocks(len(centres), len(others)):
        angle = view_angle(cdist(directions[rows], directions[others]))
        distance = cdist(centres[rows], centres[others]) / scale if scale > 0.0 else np.zeros_like(angle)
        pair = config.gamma_c * distance + config.gamma_v * angle
        # Exclude j = i: 0 does not change a maximum of distances.
        pair[rows[:, None] == others[None, :]] = 0.0
        D[rows] = pair.max(axis=1)
    return D


def visibility(
    frame_id: ArrayInt,  # [N] ascending
    observer: ArrayInt,  # [M] id of the frame that observes
    point_id: ArrayInt,  # [M]
) -> sparse.csr_array:  # [N, P] of 0 and 1
    """Return the sets P_i as a sparse matrix, without the observations of other frames.

    Repeated observations count once. Columns are ordered by point id, so that sums do not depend on the
    frames' order.
    """
    kept = np.isin(observer, frame_id)
    points, columns = np.unique(point_id[kept], return_inverse=True)
    rows = np.searchsorted(frame_id, observer[kept])
    seen = sparse.csr_array(
        (np.ones(len(columns), dtype=np.int32), (rows, columns)), shape=(len(frame_id), len(points))
    )
    seen.sum_duplicates()
    seen.data[:] = 1
    return seen


def coverage_gain(seen: sparse.csr_array, reference: ArrayBool) -> ArrayF64:  # [N, P], [N] -> C [N] in [0, 1]
    """Return C_i: the weighted share of frame i's points that no reference frame sees; 0 without points.

    The weight of a point is 1 / sqrt(n_p), where n_p is the number of frames in ``seen`` that observe it.
    """
    observers = np.bincount(seen.indices, minlength=seen.shape[1])
    weight = 1.0 / np.sqrt(np.maximum(observers, 1))
    covered = np.zeros(seen.shape[1], dtype=bool)
    covered[seen[reference].indices] = True
    total = seen @ weight
    gained = seen @ np.where(covered, 0.0, weight)
    return np.asarray(np.divide(gained, total, out=np.zeros_like(total), where=total > 0.0))


def redundancy(seen: sparse.csr_array, reference: ArrayBool) -> ArrayF64:  # [N, P], [N] -> O [N] in [0, 1]
    """Return O_i = max over reference frames j != i of |P_i and P_j| / |P_i or P_j|; 0 without such a j.

    Only pairs that share a point are visited.
    """
    largest = np.zeros(seen.shape[0])
    size = np.diff(seen.indptr)
    others = np.flatnonzero(reference)
    reference_points = seen[others].T.tocsr()
    for rows in _row_blocks(seen.shape[0], len(others)):
        shared = seen[rows] @ reference_points
        i = np.repeat(rows, np.diff(shared.indptr))
        j = others[shared.indices]
        overlap = np.where(i == j, 0.0, shared.data / (size[i] + size[j] - shared.data))
        np.maximum.at(largest, i, overlap)
    return largest


@dataclass(frozen=True)
class Bins:
    """Position of each frame in the trajectory bins."""

    index: npt.NDArray[np.int32]  # [N] bin of each frame
    centrality: ArrayF64  # [N] Z in [0, 1], 1 at the middle of the bin
    edges: ArrayF64  # [M + 1] cumulative motion at the borders of the bins


def cumulative_motion(
    centres: ArrayF64,  # [N, 3] in trajectory order
    directions: ArrayF64,  # [N, 3] unit vectors
    config: AssessmentConfig,
) -> ArrayF64:  # s [N], from 0
    """Return the cumulative pose motion s at each frame.

    A step is gamma_c d^c + gamma_v d^v between neighbours, with the distances of `pose_diversity`.
    """
    if not len(centres):
        return np.zeros(0)
    distance = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    scale = largest_distance(centres)
    if scale > 0.0:
        distance = distance / scale
    angle = view_angle(np.linalg.norm(np.diff(directions, axis=0), axis=1))
    return np.concatenate([[0.0], np.cumsum(config.gamma_c * distance + config.gamma_v * angle)])


def cut_into_bins(motion: ArrayF64, frames_per_bin: int) -> Bins:  # [N] cumulative, in trajectory order
    """Divide the trajectory into M = max(1, round(N / frames_per_bin)) bins of equal motion.

    With the total motion S and x = M s / S: bin = min(floor(x), M - 1) and Z = 1 - |2 (x - bin) - 1|. A
    camera that does not move (S = 0) has one bin with Z = 1.
    """
    total = float(motion[-1]) if len(motion) else 0.0
    if total == 0.0:
        return Bins(np.zeros(len(motion), dtype=np.int32), np.ones(len(motion)), np.zeros(2))
    count = max(1, round(len(motion) / frames_per_bin))
    position = count * motion / total
    index = np.minimum(np.floor(position), count - 1).astype(np.int32)
    # The clip removes rounding errors at the borders.
    centrality = np.clip(1.0 - np.abs(2.0 * (position - index) - 1.0), 0.0, 1.0)
    return Bins(index, centrality, total * np.arange(count + 1) / count)


def _row_blocks(n_rows: int, n_columns: int) -> list[npt.NDArray[np.intp]]:
    """Return blocks of consecutive rows with at most `_PAIRS_AT_ONCE` elements in ``n_columns`` columns."""
    step = max(1, _PAIRS_AT_ONCE // max(1, n_columns))
    return [np.arange(start, min(start + step, n_rows)) for start in range(0, n_rows, step)]
