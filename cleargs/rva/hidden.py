"""Share of a frame with something in front of the scene: a person, a hand, a pet.

Frames just before and after a frame agree on sparse points that it should see as well. A part of the frame
that sees almost none of them, where the rest of the frame sees most, is hidden. A blurred frame loses points
everywhere and has no such part.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cleargs.capture.tables import Frame, Points
from cleargs.rva.assessment import Observations, poses_from
from cleargs.rva.statistics import ramp
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.types import ArrayF64, ArrayInt

GRID = (5, 8)
"""Parts of a frame: rows and columns."""
REACH = 3
"""Number of frames on either side, of which at least one on each side must see a point."""
MIN_POINTS, SEEN_AT_MOST = 3, 0.1
"""Fewest expected points of a part, and the largest share of them that a hidden part sees."""
SEEN_ELSEWHERE = 0.5
"""Smallest share of the expected points that the rest of the frame sees."""
GHOSTING = (0.15, 0.6)
"""Hidden shares with a ghosting of 0 and of 1. Frames of still captures reach 0.12."""


def with_hidden_parts(
    cues: ArrayF64, frames: Sequence[Frame], points: Points, observations: Observations
) -> ArrayF64:  # [N, 11]
    """Return ``cues`` with b_ghosting raised to the value for the hidden parts, if that is higher."""
    shares = hidden_shares(frames, points.point_id, points.xyz, observations)
    column = CUE_COLUMNS.index("b_ghosting")
    cues = cues.copy()
    cues[:, column] = np.maximum(cues[:, column], ramp(shares, GHOSTING))
    return cues


def hidden_shares(
    frames: Sequence[Frame],
    point_id: ArrayInt,  # [P]
    xyz: ArrayF64,  # [P, 3]
    observations: Observations,
) -> ArrayF64:  # [N] in [0, 1]
    """Return, per frame, the share of the parts with expected points that are hidden.

    It is 0 for the first and the last frame, and for frames without a pose. ``frames`` are in the order of
    the trajectory.
    """
    poses, shares = poses_from(frames), np.zeros(len(frames))
    known = np.isin(observations.point_id, point_id) & np.isin(
        observations.frame_id, [frame.frame_id for frame in frames]
    )
    order = np.argsort(point_id)
    point = order[np.searchsorted(point_id, observations.point_id[known], sorter=order)]
    row = np.searchsorted([frame.frame_id for frame in frames], observations.frame_id[known])
    seen = np.zeros((len(frames), len(point_id)), np.bool_)
    seen[row, point] = True
    for k, frame in enumerate(frames):
        if not frame.registered:
            continue
        local = np.einsum("ij,pj->pi", poses.rotations[k], xyz) + poses.translations[k]
        z = np.where(local[:, 2] > 0.0, local[:, 2], np.nan)
        with np.errstate(invalid="ignore"):
            across = (local[:, 0] / z * frame.fx + frame.cx) / frame.width
            down = (local[:, 1] / z * frame.fy + frame.cy) / frame.height
            inside = (across >= 0.0) & (across < 1.0) & (down >= 0.0) & (down < 1.0)
        expected = inside & seen[max(0, k - REACH) : k].any(axis=0) & seen[k + 1 : k + 1 + REACH].any(axis=0)
        part = (down[expected] * GRID[0]).astype(np.intp) * GRID[1] + (across[expected] * GRID[1]).astype(
            np.intp
        )
        points = np.bincount(part, minlength=GRID[0] * GRID[1])
        found = np.bincount(part[seen[k, expected]], minlength=GRID[0] * GRID[1])
        counted = points >= MIN_POINTS
        hidden = counted & (found <= SEEN_AT_MOST * points)
        rest = counted & ~hidden
        if rest.any() and found[rest].sum() >= SEEN_ELSEWHERE * points[rest].sum():
            shares[k] = hidden.sum() / counted.sum()
    return shares
