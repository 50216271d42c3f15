"""``.compressed.ply``, the quantised PLY of PlayCanvas: 16 bytes per Gaussian, and one per SH coefficient.

Gaussians are grouped in chunks of 256. A chunk stores the ranges of its positions, log scales and colours in
float32. A Gaussian stores:

- its position and log scale relative to these ranges (11, 10 and 11 bits), and its colour (8 bits per
  channel);
- the three smaller components of its quaternion (10 bits each) and the index of the largest (2 bits);
- its opacity (8 bits).

Coefficients of the spherical harmonics above degree 0 have 8 bits for the range from -4 to 4. Source: the
writer of splat-transform.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cleargs.splat.constants import SH_C0
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene

CHUNK = 256
"""Number of Gaussians per chunk."""

LOG_SCALE_MAX = 20.0
"""Limit of log scales; outliers would make the range of the others too coarse."""

_MORTON_BITS = 21  # per coordinate; three fit into 63 bits
_RANGES = [
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
]
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def compressed_ply(scene: Scene) -> bytes:
    """Encode a scene, with its Gaussians in Morton order; equal scenes give equal bytes."""
    gaussians = scene.gaussians.to("cpu").detach()
    gaussians = gaussians.select(torch.from_numpy(morton_order(gaussians.means.numpy())))
    count, coefficients = gaussians.num, gaussians.sh.shape[1]
    ranges, packed = _chunks(gaussians)
    rest = 3 * (coefficients - 1)
    by_colour = gaussians.sh.numpy()[:, 1:].transpose(0, 2, 1).reshape(count, rest)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment written by ClearGS",
        f"element chunk {len(ranges)}",
        *(f"property float {name}" for name in _RANGES),
        f"element vertex {count}",
        *(f"property uint {name}" for name in _PACKED),
        *([f"element sh {count}"] if rest else []),
        *(f"property uchar f_rest_{index}" for index in range(rest)),
        "end_header\n",
    ]
    return b"".join(
        [
            "\n".join(header).encode("ascii"),
            ranges.astype("<f4").tobytes(),
            packed.astype("<u4").tobytes(),
            np.clip((by_colour / 8.0 + 0.5) * 256.0, 0, 255).astype(np.uint8).tobytes(),
        ]
    )


def morton_order(means: NDArray[np.float32]) -> NDArray[np.int64]:  # [N, 3] -> [N]
    """Return the order along a Z-order curve, in which neighbours in the file are near in space."""
    if len(means) == 0:
        return np.zeros(0, np.int64)
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    steps = (means - low) / np.maximum(high - low, 1e-12) * (2**_MORTON_BITS - 1)
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        spread = steps[:, axis].astype(np.uint64)
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            spread = (spread | (spread << np.uint64(shift))) & np.uint64(mask)
        code |= spread << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _chunks(gaussians: Gaussians) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return ranges [chunks, 18] and packed Gaussians [N, 4]. The last Gaussian fills up the last chunk."""
    count = gaussians.num
    chunks = -(-count // CHUNK)
    rows = np.minimum(np.arange(chunks * CHUNK), max(count - 1, 0))
    colours = gaussians.sh.numpy()[:, 0] * np.float32(SH_C0) + np.float32(0.5)
    scales = gaussians.log_scales.numpy().clip(-LOG_SCALE_MAX, LOG_SCALE_MAX)
    ranges, relative = [], []
    for values in (gaussians.means.numpy(), scales, colours):
        chunked = values[rows].reshape(chunks, CHUNK, 3)
        low, high = chunked.min(axis=1), chunked.max(axis=1)
        ranges += [low, high]
        width = np.where(high > low, high - low, 1.0)[:, None]
        relative.append(((chunked - low[:, None]) / width).reshape(-1, 3)[:count])
    position, scale, colour = relative
    alpha = torch.sigmoid(gaussians.logit_opacities).numpy()
    largest, smaller = smallest_three(gaussians.rotations.numpy())
    rotation = _pack((smaller * np.sqrt(0.5) + 0.5).astype(np.float32), (10, 10, 10))
    packed = [
        _pack(position, (11, 10, 11)),
        (largest.astype(np.uint32) << np.uint32(30)) | rotation,
        _pack(scale, (11, 10, 11)),
        _pack(np.column_stack([colour, alpha]), (8, 8, 8, 8)),
    ]
    return np.concatenate(ranges, axis=1), np.stack(packed, axis=1)


def _pack(values: NDArray[np.float32], bits: tuple[int, ...]) -> NDArray[np.uint32]:  # [N, K] -> [N]
    """Pack K numbers in [0, 1] with ``bits`` bits each into one integer, the first in the highest bits."""
    packed = np.zeros(len(values), np.uint32)
    for column, width in enumerate(bits):
        top = 2**width - 1
        steps = np.clip(np.floor(values[:, column] * top + 0.5), 0, top)
        packed = (packed << np.uint32(width)) | steps.astype(np.uint32)
    return packed


def smallest_three(
    quaternions: NDArray[np.floating[Any]],  # [N, 4]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:  # [N], [N, 3]
    """Return the index of each quaternion's largest component, and the other three in order.

    Quaternions are normalised, and negated if that component is negative: a decoder can then compute it.
    """
    unit = quaternions / np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-12)
    largest = np.abs(unit).argmax(axis=1)
    unit = unit * np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    return largest, np.take_along_axis(unit, others, axis=1)
