"""``.spz``, the compressed splats of Niantic: columns of fixed-point numbers.

Positions have 24 bits; opacities, colours and log scales 8 bits; the three smaller components of the
quaternions 10 bits (sign and 9 bits); and spherical harmonics 8 bits for -1 to 1. Versions 1 to 3 are one
gzip stream, a header and the columns. In version 4 each column is a Zstandard stream, and a table lists them.
Version 1 has half floats for positions; versions 1 and 2 have x, y and z of the quaternions in 8 bits.

Source: nianticlabs/spz, ``load-spz.cc`` and "File Format" in the README.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray

from cleargs.errors import InputError
from cleargs.safe_io import MAX_BYTES
from cleargs.splat.compressed_ply import smallest_three, whole_quaternions
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene

SpzVersion = Literal[3, 4]

_MAGIC = 0x5053474E
_ANTIALIASED = 1
_COLOUR_SCALE = 0.15  # the 8 bits cover SH of degree 0 from -1/0.3 to 1/0.3
_FRACTION_BITS_MAX = 20  # every reader that was tried takes these
_LOG_SCALES = (-10.0, 255 / 16 - 10.0)
_FINE, _COARSE = 1 / 32, 1 / 8  # steps of positions that are enough, and too much, in median smallest axes
_SMALL, _LARGE = 0.003, 1e-4  # shares of Gaussians outside the range of sizes that cost 0.05 dB
_MARGIN = 1 / 32  # half a step of log scales
_STREAM = struct.Struct("<QQ")  # compressed and uncompressed size


def spz(scene: Scene, version: SpzVersion = 3) -> bytes:
    """Encode a scene; equal scenes give equal bytes. Spark and Babylon read version 3, PlayCanvas version 4.

    The scene has the axes of the format: x right, y up, z back. The format has no background. InputError is
    raised if the scene is too large or too small for fixed-point numbers.
    """
    gaussians = scene.gaussians.to("cpu").detach()
    count, coefficients = gaussians.num, gaussians.sh.shape[1]
    means = gaussians.means.numpy().astype(np.float64)
    fraction = _fraction_bits(gaussians)
    steps = np.clip(np.rint(means * 2.0**fraction), -(2**23), 2**23 - 1).astype("<i4")
    columns: list[NDArray[Any]] = [
        steps.view(np.uint8).reshape(count, 3, 4)[:, :, :3],
        _byte(torch.sigmoid(gaussians.logit_opacities).numpy() * 255.0),
        _byte(gaussians.sh.numpy()[:, 0] * (_COLOUR_SCALE * 255.0) + 0.5 * 255.0),
        _byte((gaussians.log_scales.numpy() + 10.0) * 16.0),
        _rotations(gaussians.rotations.numpy()),
    ]
    if coefficients > 1:
        columns.append(_byte(gaussians.sh.numpy()[:, 1:] * 128.0 + 128.0))
    flags = _ANTIALIASED if scene.antialias else 0
    header = struct.pack("<IIIBBB", _MAGIC, version, count, gaussians.sh_degree, fraction, flags)
    parts = [column.tobytes() for column in columns]
    if version == 3:
        return gzip.compress(header + b"\0" + b"".join(parts), 9, mtime=0)
    streams = [pa.Codec("zstd", compression_level=19).compress(part, asbytes=True) for part in parts]
    table = [_STREAM.pack(len(stream), len(part)) for stream, part in zip(streams, parts, strict=True)]
    return b"".join([header, struct.pack("<BI12x", len(parts), 32), *table, *streams])


def _fraction_bits(gaussians: Gaussians) -> int:
    """Return the bits after the binary point: of 24 (with sign), those that the largest coordinate leaves."""
    reach = float(gaussians.means.abs().max()) if gaussians.num else 1.0
    if reach >= 2.0**23:
        raise InputError(
            f"the scene has coordinates up to {reach:.1e}, but .spz stores at most 8 million",
            hint="export it in the normalised world (without --world input), or in another format",
        )
    sizes = gaussians.log_scales[torch.sigmoid(gaussians.logit_opacities) >= 0.5 / 255].sort(dim=1).values
    if not len(sizes):
        return 0
    thin = float(sizes[:, 0].median().exp())
    most = min(int(np.floor(23 - np.log2(max(reach, 1e-9)) - 1e-9)), _FRACTION_BITS_MAX)
    # A disc that gets thicker looks nearly the same, so only its second axis must not be too short.
    small, large = (float(_outside(sizes[:, axis]).float().mean()) for axis in (1, 2))
    if np.exp(_LOG_SCALES[0]) < _COARSE * thin:
        small = 0.0  # specks that are enlarged to the least size are still far smaller than the others
    if small > _SMALL or large > _LARGE or 2.0**-most > _COARSE * thin:
        raise InputError(
            ".spz cannot hold the scene: it stores lengths from 0.000045 to 380 units, and positions in "
            f"steps of {2.0**-most:.1g} units at this size",
            hint="export it as .sog, or in another size (--metres; without --world input)",
        )
    return int(np.clip(np.ceil(-np.log2(max(_FINE * thin, 1e-9))), 0, most))


def _outside(log_scales: torch.Tensor) -> torch.Tensor:
    """Return a mask of the log scales that the format clips."""
    low, high = _LOG_SCALES
    return (log_scales < low - _MARGIN) | (log_scales > high + _MARGIN)


def spz_remarks(scene: Scene) -> list[str]:
    """Return what the format changes in this scene."""
    sh, sizes = scene.gaussians.sh, scene.gaussians.log_scales.sort(dim=1).values
    found = [
        ("harmonics beyond 1", (sh[:, 1:].abs() > 1.0 + 1 / 128).any(dim=(1, 2))),
        ("colours out of range", (sh[:, 0].abs() > 0.5 / _COLOUR_SCALE).any(dim=1)),
        ("sizes out of range", _outside(sizes[:, 1:]).any(dim=1)),
    ]
    return [
        f"{what} in {number} of {len(sh)} Gaussians: clipped; .sog holds them"
        for what, which in found
        if (number := int(which.sum()))
    ]


def from_spz(content: bytes) -> Scene:
    """Decode version 1 to 4, with the axes of the format. Raises one of `FAULTS` if it is another file."""
    if content[:2] == b"\x1f\x8b":
        content = zlib.decompressobj(31).decompress(content, MAX_BYTES)
    magic, version, count, degree, fraction, flags, streams = struct.unpack_from("<IIIBBBB", content)
    if magic != _MAGIC or version not in (1, 2, 3, 4):
        raise ValueError("not an .spz of version 1 to 4")
    if degree > 3:
        raise ValueError(f"it has spherical harmonics of degree {degree}")
    widths = [6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * ((degree + 1) ** 2 - 1)]
    sizes = [count * width for width in widths]
    if version == 4:
        (start,) = struct.unpack_from("<I", content, 16)
        table = [_STREAM.unpack_from(content, start + 16 * index) for index in range(streams)]
        if [size for _, size in table] != sizes[:streams] or sum(sizes[streams:]):
            raise ValueError("the sizes of its columns do not fit its header")
        at, codec, columns = start + 16 * streams, pa.Codec("zstd"), []
        for packed, size in table:
            columns.append(bytes(codec.decompress(content[at : at + packed], size, asbytes=True)))
            at += packed
        content = b"".join(columns)
    else:
        content = content[16:]
    ends = np.cumsum(sizes).tolist()
    if ends[-1] > len(content):
        raise ValueError("it is truncated")
    positions, alphas, colours, scales, rotations, rest = (
        np.frombuffer(content, np.uint8, size, end - size).reshape(count, width)
        for size, end, width in zip(sizes, ends, widths, strict=True)
    )
    if version == 1:
        means = positions.view("<f2").astype(np.float64)
    else:
        bits = positions.reshape(count, 3, 3).astype(np.int64) @ np.array([1, 1 << 8, 1 << 16])
        means = ((bits ^ 0x800000) - 0x800000) / 2.0**fraction
    if version < 3:
        xyz = rotations / 127.5 - 1.0
        quaternions = whole_quaternions(np.zeros(count, np.int64), xyz)
    else:
        packed = np.ascontiguousarray(rotations).view("<u4")[:, 0]
        parts = packed[:, None] >> np.array([20, 10, 0], np.uint32) & 1023
        smaller = (parts & 511) / (511.0 * np.sqrt(2.0)) * np.where(parts & 512, -1.0, 1.0)
        quaternions = np.roll(whole_quaternions(packed >> 30, smaller), 1, axis=1)  # x y z w -> w x y z

    def tensor(values: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(values.astype(np.float32))

    dc = tensor((colours / 255.0 - 0.5) / _COLOUR_SCALE)
    sh = torch.cat([dc[:, None], tensor(rest / 128.0 - 1.0).reshape(count, -1, 3)], dim=1)
    gaussians = Gaussians(
        means=tensor(means),
        log_scales=tensor(scales / 16.0 - 10.0),
        rotations=torch.from_numpy(quaternions),
        logit_opacities=torch.logit(tensor(alphas[:, 0] / 255.0)),
        sh=sh,
    )
    return Scene(gaussians.bounded(), antialias=bool(flags & _ANTIALIASED))


def _byte(values: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def _rotations(quaternions: NDArray[np.float32]) -> NDArray[np.uint32]:  # [N, 4] w x y z -> [N]
    """Pack the index of the largest of x, y, z, w, then sign and magnitude * sqrt(2) of the others."""
    # + 0.0 turns -0.0 into 0.0.
    largest, smaller = smallest_three(quaternions[:, [1, 2, 3, 0]].astype(np.float64) + 0.0)
    packed: NDArray[np.uint32] = largest.astype(np.uint32)
    for part in smaller.T:
        magnitude = np.clip(np.floor(511.0 * np.sqrt(2.0) * np.abs(part) + 0.5), 0, 511).astype(np.uint32)
        packed = (packed << np.uint32(10)) | (np.signbit(part).astype(np.uint32) << np.uint32(9)) | magnitude
    return packed
