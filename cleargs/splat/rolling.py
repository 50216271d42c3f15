"""A rolling shutter in the projection: each Gaussian is seen from the pose at which its row was read.

A Gaussian at X, in the coordinates of the camera at the middle of the readout, is seen at the place s of the
readout, from -1/2 to 1/2, that solves

    X'(s) = R(s) X + t(s),      s = slope * y'/z' + start        (x'/z' if columns are read)

with the motion of the scene past the camera from `Readout`. Newton's method finds s. Around X the map is
linear,

    dX' = (R + V gᵀ) dX,        V = dX'/ds,        g = ds/dX,

so the kernels project each Gaussian with a different pose, which also shears it as the picture is sheared.
Depths, and with them the order of the Gaussians, are those of the camera at the middle of the readout.
"""

from __future__ import annotations

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

Vector = tuple[Tensor, Tensor, Tensor]  # [N] each


def own_poses(means: Tensor, camera: Camera) -> Tensor | None:
    """Return the pose of the camera for each Gaussian; None if the shutter does not roll.

    ``means`` are [N, 3] in the world. A pose is three rows of a linear map, then the shift: [N, 12] float64.
    """
    readout = camera.readout
    if readout is None:
        return None
    pose = camera.world_to_camera.tolist()
    x, y, z = means.detach().double().unbind(1)
    still: Vector = tuple(row[0] * x + row[1] * y + row[2] * z + row[3] for row in pose[:3])
    along = 0 if readout.columns else 1
    place = _limited(readout, still, along)
    for _ in range(STEPS):
        _, seen, speed = _at(readout, still, place)
        gain = _slope_of(readout, seen, speed, along)
        there = readout.slope * seen[along] / seen[2].clamp(min=NEAR) + readout.start
        place = (place - (place - there) / (1.0 - gain)).clamp(-BEYOND, BEYOND)
    turn, seen, speed = _at(readout, still, place)
    # ds = h · R dX / (1 - h · V), with h = ds/dX'; 0 where the place is limited.
    depth = seen[2].clamp(min=NEAR)
    rate = readout.slope / depth / (1.0 - _slope_of(readout, seen, speed, along))
    rate = torch.where(place.abs() < BEYOND, rate, torch.zeros_like(rate))
    by_depth = seen[along] / depth
    by_still = [rate * (turn[along][k] - by_depth * turn[2][k]) for k in range(3)]
    rows = []
    for i in range(3):
        own = [turn[i][k] + speed[i] * by_still[k] for k in range(3)]
        rows.append([own[0] * pose[0][j] + own[1] * pose[1][j] + own[2] * pose[2][j] for j in range(3)])
    shift = [seen[i] - (rows[i][0] * x + rows[i][1] * y + rows[i][2] * z) for i in range(3)]
    return torch.stack([*rows[0], *rows[1], *rows[2], *shift], dim=1)


def _limited(readout: Readout, seen: Vector, along: int) -> Tensor:
    return (readout.slope * seen[along] / seen[2].clamp(min=NEAR) + readout.start).clamp(-BEYOND, BEYOND)


def _slope_of(readout: Readout, seen: Vector, speed: Vector, along: int) -> Tensor:
    """Return h · V, the change of the place that the pixel has by that at which it is read."""
    depth = seen[2].clamp(min=NEAR)
    gain = readout.slope / depth * (speed[along] - seen[along] / depth * speed[2])
    return gain.clamp(-STEEPEST, STEEPEST)


def _at(
    readout: Readout, still: Vector, place: Tensor
) -> tuple[tuple[Vector, Vector, Vector], Vector, Vector]:
    """Return the rows of R, X' and V at a place of the readout."""
    pose, first, second = readout.twists.tolist()
    twist = [pose[k] + place * (first[k] + place * second[k]) for k in range(6)]
    change = [first[k] + 2.0 * place * second[k] for k in range(6)]
    rx, ry, rz = twist[3:]
    squared = rx * rx + ry * ry + rz * rz
    # Rodrigues: R = I + a [r] + b [r]². The series are exact to 1e-9 up to a third of a radian.
    a = 1.0 - squared / 6.0 * (1.0 - squared / 20.0 * (1.0 - squared / 42.0))
    b = 0.5 - squared / 24.0 * (1.0 - squared / 30.0 * (1.0 - squared / 56.0))
    turn = (
        (1.0 - b * (ry * ry + rz * rz), b * rx * ry - a * rz, b * rx * rz + a * ry),
        (b * rx * ry + a * rz, 1.0 - b * (rx * rx + rz * rz), b * ry * rz - a * rx),
        (b * rx * rz - a * ry, b * ry * rz + a * rx, 1.0 - b * (rx * rx + ry * ry)),
    )
    turned = [row[0] * still[0] + row[1] * still[1] + row[2] * still[2] for row in turn]
    dx, dy, dz = change[3:]
    speed = (
        change[0] + dy * turned[2] - dz * turned[1],
        change[1] + dz * turned[0] - dx * turned[2],
        change[2] + dx * turned[1] - dy * turned[0],
    )
    return turn, (turned[0] + twist[0], turned[1] + twist[1], turned[2] + twist[2]), speed
