"""A rolling shutter in the projection: each Gaussian is seen from the pose at which its row was read.

A Gaussian at X, in the coordinates of the camera at the middle of the readout, is seen at the place s of the
readout, from -1/2 to 1/2, that solves

    X'(s) = R(s) X + t(s),      s = slope * y'/z' + start        (x'/z' if columns are read)

with the motion of the scene past the camera from `Readout`. Newton's method finds s. Around X the map is
linear,

    dX' = (R + V gᵀ) dX,        V = dX'/ds,        g = ds/dX,

so the kernels project each Gaussian with a different pose, which also shears it as the picture is sheared.
Depths, and with them the order of the Gaussians, are those of the camera at the middle of the readout.

These functions are for tensors. The CPU's kernel takes the same steps in a thirtieth of the time, and calls
`seen_at` too.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cleargs.splat.camera import Camera, Readout
from cleargs.splat.constants import NEAR

STEPS = 2
"""Steps of Newton's method. A place is then known to 1e-4 of the readout."""
BEYOND = 0.75
"""Largest place within the readout: what is outside the picture moves no further."""
STEEPEST = 0.8
"""Upper limit of V · ds/dX', the speed of the image as a share of that of the readout. At 1, a point follows
the rows that are read, and has no single place."""

Triple = tuple[Any, Any, Any]  # three floats, or three tensors [N]


def own_poses(means: Tensor, camera: Camera) -> Tensor | None:
    """Return the pose of the camera for each Gaussian; None if the shutter does not roll.

    ``means`` are [N, 3] in the world. A pose is three rows of a linear map, then the shift: [N, 12] float64.
    """
    readout = camera.readout
    if readout is None:
        return None
    pose, (middle, first, second) = camera.world_to_camera.tolist(), readout.twists.tolist()
    x, y, z = means.detach().double().unbind(1)
    still_x, still_y, still_z = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in pose[:3])
    along = 0 if readout.columns else 1
    place = _place_of(readout, (still_x, still_y, still_z), along)
    for _ in range(STEPS):
        _, seen, speed = seen_at(middle, first, second, place, still_x, still_y, still_z)
        error = place - _place_of(readout, seen, along)
        place = (place - error / (1.0 - _gain(readout, seen, speed, along))).clamp(-BEYOND, BEYOND)
    turn, seen, speed = seen_at(middle, first, second, place, still_x, still_y, still_z)
    # ds = h · R dX / (1 - h · V), with h = ds/dX'; 0 where the place is limited.
    depth = seen[2].clamp(min=NEAR)
    rate = readout.slope / depth / (1.0 - _gain(readout, seen, speed, along))
    rate = torch.where(place.abs() < BEYOND, rate, torch.zeros_like(rate))
    by_still = [rate * (turn[along][k] - seen[along] / depth * turn[2][k]) for k in range(3)]
    rows = []
    for i in range(3):
        own = [turn[i][k] + speed[i] * by_still[k] for k in range(3)]
        rows.append([own[0] * pose[0][j] + own[1] * pose[1][j] + own[2] * pose[2][j] for j in range(3)])
    shift = [seen[i] - (rows[i][0] * x + rows[i][1] * y + rows[i][2] * z) for i in range(3)]
    return torch.stack([*rows[0], *rows[1], *rows[2], *shift], dim=1)


def _place_of(readout: Readout, seen: Any, along: int) -> Tensor:
    """Return the place of the readout at which the pixel of a point is read."""
    place: Tensor = readout.slope * seen[along] / seen[2].clamp(min=NEAR) + readout.start
    return place.clamp(-BEYOND, BEYOND)


def _gain(readout: Readout, seen: Any, speed: Any, along: int) -> Tensor:
    """Return h · V, the change of the place that the pixel has by that at which it is read."""
    depth = seen[2].clamp(min=NEAR)
    gain: Tensor = readout.slope / depth * (speed[along] - seen[along] / depth * speed[2])
    return gain.clamp(-STEEPEST, STEEPEST)


def seen_at(
    pose: Any, first: Any, second: Any, place: Any, x: Any, y: Any, z: Any
) -> tuple[tuple[Triple, Triple, Triple], Triple, Triple]:
    """Return the rows of R, X' and V at a ``place`` of the readout: arithmetic on floats or tensors.

    ``pose``, ``first`` and ``second`` are the twists of `Readout`, six floats each; x, y, z are X.
    """
    rx = pose[3] + place * (first[3] + place * second[3])
    ry = pose[4] + place * (first[4] + place * second[4])
    rz = pose[5] + place * (first[5] + place * second[5])
    squared = rx * rx + ry * ry + rz * rz
    # Rodrigues: R = I + a [r] + b [r]². The series are exact to 1e-9 up to a third of a radian.
    a = 1.0 - squared / 6.0 * (1.0 - squared / 20.0 * (1.0 - squared / 42.0))
    b = 0.5 - squared / 24.0 * (1.0 - squared / 30.0 * (1.0 - squared / 56.0))
    turn = (
        (1.0 - b * (ry * ry + rz * rz), b * rx * ry - a * rz, b * rx * rz + a * ry),
        (b * rx * ry + a * rz, 1.0 - b * (rx * rx + rz * rz), b * ry * rz - a * rx),
        (b * rx * rz - a * ry, b * ry * rz + a * rx, 1.0 - b * (rx * rx + ry * ry)),
    )
    tx = turn[0][0] * x + turn[0][1] * y + turn[0][2] * z
    ty = turn[1][0] * x + turn[1][1] * y + turn[1][2] * z
    tz = turn[2][0] * x + turn[2][1] * y + turn[2][2] * z
    dx, dy, dz = (
        first[3] + 2.0 * place * second[3],
        first[4] + 2.0 * place * second[4],
        first[5] + 2.0 * place * second[5],
    )
    speed = (
        first[0] + 2.0 * place * second[0] + dy * tz - dz * ty,
        first[1] + 2.0 * place * second[1] + dz * tx - dx * tz,
        first[2] + 2.0 * place * second[2] + dx * ty - dy * tx,
    )
    seen = (
        tx + pose[0] + place * (first[0] + place * second[0]),
        ty + pose[1] + place * (first[1] + place * second[1]),
        tz + pose[2] + place * (first[2] + place * second[2]),
    )
    return turn, seen, speed
