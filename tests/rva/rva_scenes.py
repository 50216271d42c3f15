"""Small captures for the tests of RVA's formulas: cameras on the x axis, scores set through uniform cues."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from cleargs.rva.assessment import Observations, Poses

Floats = npt.NDArray[np.float64]

FORWARD = np.eye(3)
BACKWARD = np.diag([-1.0, 1.0, -1.0])  # half a turn about y


def uniform_cues(R: Sequence[float], B: Sequence[float]) -> Floats:
    """Cues [N, 11] with the scores R and B: all r cues are R and all b cues are B, since weights sum to 1."""
    r, b = np.asarray(R, dtype=float)[:, None], np.asarray(B, dtype=float)[:, None]
    return np.hstack([np.repeat(r, 5, axis=1), np.repeat(b, 6, axis=1)])


def poses_at(
    centres: Floats, rotations: Floats | None = None, registered: Sequence[bool] | None = None
) -> Poses:  # [N, 3], [N, 3, 3] world to camera
    """Poses with these camera centres. By default they look along +z and are registered."""
    n = len(centres)
    turned = np.tile(FORWARD, (n, 1, 1)) if rotations is None else rotations
    present = np.ones(n, dtype=bool) if registered is None else np.asarray(registered, dtype=bool)
    return Poses(turned, -np.einsum("nij,nj->ni", turned, centres), present)


def observations_of(points: Mapping[int, Sequence[int]]) -> Observations:
    """Observations from a map of frame id -> ids of the points that it sees."""
    pairs = [(frame, point) for frame, seen in points.items() for point in seen]
    table = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return Observations(table[:, 0], table[:, 1])


def along_x(positions: Sequence[float]) -> Floats:
    """Camera centres on the x axis."""
    centres = np.zeros((len(positions), 3))
    centres[:, 0] = positions
    return centres
