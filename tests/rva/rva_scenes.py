"""Small posed captures for the tests of the maths: cameras on the x axis, scores set through uniform cues."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from cleargs.rva.assessment import Observations, Poses

Floats = npt.NDArray[np.float64]

FORWARD = np.eye(3)
BACKWARD = np.diag([-1.0, 1.0, -1.0])  # half a turn about y


def uniform_cues(R: Sequence[float], B: Sequence[float]) -> Floats:
    """Cues that are all R, or all B: the weights sum to 1, so the scores are R and B."""
    r, b = np.asarray(R, dtype=float)[:, None], np.asarray(B, dtype=float)[:, None]
    return np.hstack([np.repeat(r, 5, axis=1), np.repeat(b, 6, axis=1)])


def poses_at(
    centres: Floats, rotations: Floats | None = None, registered: Sequence[bool] | None = None
) -> Poses:  # [N, 3], [N, 3, 3] world to camera
    """Poses with these camera centres, looking along +z unless told otherwise."""
    n = len(centres)
    turned = np.tile(FORWARD, (n, 1, 1)) if rotations is None else rotations
    present = np.ones(n, dtype=bool) if registered is None else np.asarray(registered, dtype=bool)
    return Poses(turned, -np.einsum("nij,nj->ni", turned, centres), present)


def observations_of(points: Mapping[int, Sequence[int]]) -> Observations:
    """Frame id -> the ids of the points that it sees."""
    pairs = [(frame, point) for frame, seen in points.items() for point in seen]
    table = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return Observations(table[:, 0], table[:, 1])


def along_x(positions: Sequence[float]) -> Floats:
    """Camera centres on the x axis."""
    centres = np.zeros((len(positions), 3))
    centres[:, 0] = positions
    return centres
