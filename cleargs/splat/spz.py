"""``.spz``, the compressed splats of Niantic: columns of fixed-point numbers.

Version 3 of the format is one gzip stream: a header; positions of 24 bits; opacities, colours and log scales
of 8 bits; the three smaller components of the quaternions, of 10 bits (sign and 9 bits); and spherical
harmonics of 8 bits for -1 to 1. Source: nianticlabs/spz, ``load-spz.cc`` and "File Format" in the README.
"""

from __future__ import annotations

import gzip
import struct
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cleargs.errors import InputError
from cleargs.splat.compressed_ply import smallest_three
from cleargs.splat.scene import Scene

_MAGIC, _VERSION = 0x5053474E, 3
_ANTIALIASED = 1
_COLOUR_SCALE = 0.15  # the 8 bits cover SH of degree 0 from -1/0.3 to 1/0.3
_SH_STEPS = (8, 16)  # coefficients of degree 1 are rounded to 5 bits, higher ones to 4 (load-spz.cc)
_FRACTION_BITS_MAX = 12  # for positions (load-spz.cc)


def spz(scene: Scene) -> bytes:
    """Encode a scene in version 3 of the format, which most programs read; equal scenes give equal bytes.

    The scene has the axes of the format: x right, y up, z back. The format has no background. InputError is
    raised if the scene is too large for fixed-point positions.
    """
    gaussians = scene.gaussians.to("cpu").detach()
    count, coefficients = gaussians.num, gaussians.sh.shape[1]
    means = gaussians.means.numpy().astype(np.float64)
    reach = float(np.abs(means).max(initial=1e-9))
    if reach >= 2.0**23:
        raise InputError(
            f"the scene has coordinates up to {reach:.1e}, but .spz stores at most 8 million",
            hint="export it in the normalised world (without --world input), or in another format",
        )
    # Bits after the binary point: those of the 24 bits (with sign) that the largest coordinate does not need.
    fraction = int(np.clip(np.floor(23 - np.log2(max(reach, 1e-9)) - 1e-9), 0, _FRACTION_BITS_MAX))
    flags = _ANTIALIASED if scene.antialias else 0
    header = struct.pack("<IIIBBBx", _MAGIC, _VERSION, count, gaussians.sh_degree, fraction, flags)
    steps = np.clip(np.rint(means * 2.0**fraction), -(2**23), 2**23 - 1).astype("<i4")
    positions = steps.view(np.uint8).reshape(count, 3, 4)[:, :, :3]
    alphas = _byte(torch.sigmoid(gaussians.logit_opacities).numpy() * 255.0)
    colours = _byte(gaussians.sh.numpy()[:, 0] * (_COLOUR_SCALE * 255.0) + 0.5 * 255.0)
    scales = _byte((gaussians.log_scales.numpy() + 10.0) * 16.0)
    rotations = _rotations(gaussians.rotations.numpy())
    columns: list[NDArray[Any]] = [positions, alphas, colours, scales, rotations]
    if coefficients > 1:
        columns.append(_harmonics(gaussians.sh.numpy()[:, 1:]))
    return gzip.compress(header + b"".join(column.tobytes() for column in columns), 9, mtime=0)


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


def _harmonics(sh: NDArray[np.float32]) -> NDArray[np.uint8]:  # [N, K - 1, 3]
    """Encode coefficients as 128 + 128 * value, rounded to multiples of a step."""
    steps = np.where(np.arange(sh.shape[1]) < 3, *_SH_STEPS)[:, None]
    raw = np.rint(sh * 128.0) + 128.0
    return _byte(np.floor((raw + steps / 2) / steps) * steps)
