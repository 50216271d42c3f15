"""``.compressed.ply``, the quantised PLY of PlayCanvas: 16 bytes per Gaussian, and one per SH coefficient.

Gaussians are grouped in chunks of 256. A chunk stores the ranges of its positions, log scales and colours in
float32. A Gaussian stores:

- its position and log scale relative to these ranges (11, 10 and 11 bits), and its colour (8 bits per
  channel);
- the three smaller components of its quaternion (10 bits each) and the index of the largest (2 bits);
- its opacity (8 bits).

Coefficients of the spherical harmonics above degree 0 have 8 bits for the range from -4 to 4: n stands for
(n + 0.5) / 32 - 4, so no level is 0. Degrees of zeros only are therefore left out. If the cameras are
known, the rounding of one coefficient makes up for that of others in the directions from which they see the
Gaussian (0.02 dB lost in place of 0.31 in a scene of degree 3).

Source of the format: the reader and the writer of splat-transform.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cleargs.splat.constants import SH_C0
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.transforms import sh_basis

SH_MAX = 4.0
"""Largest magnitude of a coefficient of the harmonics above degree 0."""

CHUNK = 256
"""Number of Gaussians per chunk."""

_ZERO = 1e-5  # rotated zeros are rounded
_ALL_AROUND = 0.01  # share of all other directions next to those of the cameras
_AT_ONCE = 4096  # Gaussians, which limits memory

LOG_SCALE_MAX = 20.0
"""Limit of log scales; outliers would make the range of the others too coarse."""

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # largest component -> the other three
_SIZE_BITS, _COLOUR_BITS = (11, 10, 11), (8, 8, 8, 8)
_MORTON_BITS = 21  # per coordinate; three fit into 63 bits
_RANGES = [
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
]
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def compressed_ply(scene: Scene, eyes: NDArray[np.float64] | None = None) -> bytes:
    """Encode a scene, with its Gaussians in Morton order; equal scenes give equal bytes.

    ``eyes`` [M, 3] are the centres of the cameras that should see the colours with the least error.
    """
    gaussians = without_zero_degrees(scene.gaussians.to("cpu").detach())
    gaussians = gaussians.select(torch.from_numpy(morton_order(gaussians.means.numpy())))
    if eyes is not None and len(eyes) and gaussians.sh_degree:
        gaussians = replace(gaussians, sh=torch.from_numpy(_rounded(gaussians, eyes)))
    count, coefficients = gaussians.num, gaussians.sh.shape[1]
    ranges, packed = _chunks(gaussians)
    rest = 3 * (coefficients - 1)
    by_colour = gaussians.sh.numpy()[:, 1:].transpose(0, 2, 1).reshape(count, rest)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment written by ClearGS",
        f"comment SplatRenderMode: {'mip' if scene.antialias else 'default'}",
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
            _levels(by_colour).tobytes(),
        ]
    )


def without_zero_degrees(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians without the highest degrees of harmonics in which all coefficients are 0."""
    degree = gaussians.sh_degree
    while degree and not bool((gaussians.sh[:, degree**2 :].abs() > _ZERO).any()):
        degree -= 1
    return replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2].contiguous())


def compressed_remarks(scene: Scene, eyes: NDArray[np.float64] | None = None) -> list[str]:
    """Return what the format changes in this scene, if it was written with these ``eyes``."""
    found, sh = [], scene.gaussians.sh
    if (left := without_zero_degrees(scene.gaussians).sh_degree) < scene.gaussians.sh_degree:
        found.append(f"written with harmonics of degree {left}, because the format has no zeros")
    if left > 1 and eyes is None:
        found.append(
            "harmonics are rounded to 1/32, which cost 0.3 to 0.4 dB in trained scenes; .sog cost 0.01 dB"
        )
    if beyond := int((sh[:, 1:].abs() > SH_MAX + 1 / 64).any(dim=2).any(dim=1).sum()):
        found.append(
            f"harmonics beyond {SH_MAX:g} in {beyond} of {len(sh)} Gaussians: clipped; .sog holds them"
        )
    return found


def _rounded(gaussians: Gaussians, eyes: NDArray[np.float64]) -> NDArray[np.float32]:  # [N, K, 3]
    """Round the coefficients, from the highest to that of degree 1, and change those that follow to fit.

    The change of the colour is least, squared and summed over the directions from ``eyes`` [M, 3]. The colour
    of degree 0 is only changed; it has finer steps. This is the rounding of GPTQ (Frantar et al. 2023).
    """
    found = gaussians.sh.numpy()[:, ::-1].astype(np.float64)
    count = found.shape[1]
    for start in range(0, len(found), _AT_ONCE):
        part = found[start : start + _AT_ONCE]
        seen = gaussians.means[start : start + _AT_ONCE].numpy()[:, None] - eyes
        seen /= np.maximum(np.linalg.norm(seen, axis=2, keepdims=True), 1e-12)
        basis = sh_basis(torch.from_numpy(seen), count).numpy()[:, :, ::-1]
        weights = np.einsum("nmk,nml->nkl", basis, basis) / len(eyes) + _ALL_AROUND * np.eye(count)
        lower = np.linalg.cholesky(np.linalg.inv(weights))
        for k in range(count - 1):
            exact = part[:, k].copy()
            part[:, k] = (np.clip(np.floor(exact * 32.0 + 128.0), 0, 255) + 0.5) / 32.0 - SH_MAX
            change = ((exact - part[:, k]) / lower[:, k, k, None])[:, None]  # [n, 1, 3]
            part[:, k + 1 :] -= lower[:, k + 1 :, k, None] * change
    return np.ascontiguousarray(found[:, ::-1], np.float32)


def _levels(sh: NDArray[np.float32]) -> NDArray[np.uint8]:  # [N, 3 (K - 1)] -> the same
    """Encode coefficients. 0 is between two levels; both are used in turn, so that the errors cancel."""
    levels: NDArray[np.uint8] = np.clip((sh / 8.0 + 0.5) * 256.0, 0, 255).astype(np.uint8)
    row, column = np.nonzero(np.abs(sh) <= _ZERO)
    levels[row, column] = 127 + (row + column) % 2
    return levels


def unpacked(elements: Mapping[str, NDArray[np.void]]) -> Gaussians:
    """Decode the Gaussians of the elements ``chunk``, ``vertex`` and ``sh`` of a ``.compressed.ply``.

    Raises a LookupError or ValueError if they do not fit together.
    """
    chunk, vertex = elements["chunk"], elements["vertex"]
    which = np.arange(len(vertex)) // CHUNK

    def ranged(values: NDArray[np.float64], *names: str) -> torch.Tensor:
        low, high = (
            np.stack([chunk[f"{end}_{name}"] for name in names], axis=1)[which] for end in ("min", "max")
        )
        return torch.from_numpy((low + values * (high.astype(np.float64) - low)).astype(np.float32))

    colour = _unpack(vertex["packed_color"], _COLOUR_BITS)
    rotation = (_unpack(vertex["packed_rotation"] & 0x3FFFFFFF, (10, 10, 10)) - 0.5) * np.sqrt(2.0)
    colours = torch.from_numpy(colour[:, :3].astype(np.float32))
    if "min_r" in (chunk.dtype.names or ()):  # files of 2024 have colours from 0 to 1
        colours = ranged(colour[:, :3], "r", "g", "b")
    sh = ((colours - 0.5) / SH_C0)[:, None]
    if "sh" in elements:
        names = elements["sh"].dtype.names or ()
        levels = np.stack([elements["sh"][f"f_rest_{index}"] for index in range(len(names))], axis=1)
        rest = (levels.reshape(len(vertex), 3, -1).transpose(0, 2, 1) + 0.5) / 32.0 - SH_MAX
        sh = torch.cat([sh, torch.from_numpy(rest.astype(np.float32))], dim=1)
    return Gaussians(
        means=ranged(_unpack(vertex["packed_position"], _SIZE_BITS), "x", "y", "z"),
        log_scales=ranged(_unpack(vertex["packed_scale"], _SIZE_BITS), "scale_x", "scale_y", "scale_z"),
        rotations=torch.from_numpy(whole_quaternions(vertex["packed_rotation"] >> 30, rotation)),
        logit_opacities=torch.logit(torch.from_numpy(colour[:, 3].astype(np.float32))),
        sh=sh,
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
        _pack(position, _SIZE_BITS),
        (largest.astype(np.uint32) << np.uint32(30)) | rotation,
        _pack(scale, _SIZE_BITS),
        _pack(np.column_stack([colour, alpha]), _COLOUR_BITS),
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


def _unpack(packed: NDArray[np.integer[Any]], bits: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the numbers in [0, 1] [N, K] that `_pack` packed."""
    columns = []
    for width in reversed(bits):
        columns.append((packed & (2**width - 1)) / (2**width - 1))
        packed = packed >> width
    return np.stack(columns[::-1], axis=1)


def smallest_three(
    quaternions: NDArray[np.floating[Any]],  # [N, 4]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:  # [N], [N, 3]
    """Return the index of each quaternion's largest component, and the other three in order.

    Quaternions are normalised, and negated if that component is negative: a decoder can then compute it.
    """
    unit = quaternions / np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-12)
    largest = np.abs(unit).argmax(axis=1)
    unit = unit * np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1.0, 1.0)
    return largest, np.take_along_axis(unit, _OTHERS[largest], axis=1)


def whole_quaternions(
    largest: NDArray[np.integer[Any]],  # [N]
    smaller: NDArray[np.float64],  # [N, 3]
) -> NDArray[np.float32]:  # [N, 4]
    """Return the unit quaternions of the parts that `smallest_three` returns."""
    unit = np.empty((len(largest), 4))
    np.put_along_axis(unit, _OTHERS[largest], smaller, axis=1)
    left = np.sqrt(np.maximum(0.0, 1.0 - (smaller**2).sum(axis=1)))
    np.put_along_axis(unit, largest.astype(np.int64)[:, None], left[:, None], axis=1)
    return unit.astype(np.float32)
