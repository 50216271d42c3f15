"""``.sog``, PlayCanvas's scenes for the web: lossless WebP pictures with one Gaussian a pixel, in a zip.

Positions are 16 bits of sign(x) log(1 + |x|) in two pictures; quaternions three parts of 8 bits and which
was left out; log scales and colours point into codebooks of 256 numbers, opacities are 8 bits. Spherical
harmonics above degree 0 point into a palette, whose numbers point into a third codebook. Source: the format's
version 2 as splat-transform reads and writes it.
"""

from __future__ import annotations

import heapq
import io
import json
import zipfile
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cleargs.splat.compressed_ply import LOG_SCALE_MAX, morton_order, smaller_parts
from cleargs.splat.scene import Scene
from cleargs.types import ImageU8

_CODES = 256
_PALETTE_MAX = 65536  # labels have 16 bits
_PALETTE_STEP, _PALETTE_ROW = 1024, 64  # palettes come in such steps; so many vectors in a row of the picture
_LOSSLESS = 101  # OpenCV: a quality above 100
_WHEN = (1980, 1, 1, 0, 0, 0)  # zip knows no earlier date


def sog(scene: Scene) -> bytes:
    """The bytes of ``scene``; equal scenes give equal bytes. Gaussians come out in Morton order."""
    gaussians = scene.gaussians.to("cpu").detach()
    gaussians = gaussians.select(torch.from_numpy(morton_order(gaussians.means.numpy())))
    count, sh = gaussians.num, gaussians.sh.numpy()
    pictures: dict[str, ImageU8] = {}

    means = gaussians.means.numpy().astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(axis=0), logs.max(axis=0)
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1.0) * 65535.0).astype(np.uint16)
    pictures["means_l"] = _picture((steps & 255).astype(np.uint8))
    pictures["means_u"] = _picture((steps >> 8).astype(np.uint8))

    largest, smaller = smaller_parts(gaussians.rotations.numpy())
    parts = np.rint((smaller * np.sqrt(2.0) * 0.5 + 0.5) * 255.0).astype(np.uint8)
    pictures["quats"] = _picture(parts, (252 + largest).astype(np.uint8))

    log_scales = gaussians.log_scales.numpy().clip(-LOG_SCALE_MAX, LOG_SCALE_MAX)
    scales = codebook(log_scales, _CODES)
    pictures["scales"] = _picture(nearest(scales, log_scales))
    colours = codebook(sh[:, 0], _CODES)
    alpha = np.rint(torch.sigmoid(gaussians.logit_opacities).numpy() * 255.0).astype(np.uint8)
    pictures["sh0"] = _picture(nearest(colours, sh[:, 0]), alpha)

    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "ClearGS"},
        "count": count,
        **({"model": "antialiased"} if scene.antialias else {}),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colours.tolist(), "files": ["sh0.webp"]},
    }
    if gaussians.sh_degree:
        pictures["shN_centroids"], pictures["shN_labels"], codes, size = _harmonics(sh[:, 1:])
        meta["shN"] = {
            "count": size,
            "bands": gaussians.sh_degree,
            "codebook": codes.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo("meta.json", _WHEN), json.dumps(meta))
        for name, picture in pictures.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.webp", _WHEN), _webp(picture))
    return content.getvalue()


def _harmonics(
    rest: NDArray[np.float32],  # [N, K - 1, 3]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32], int]:
    """Picture of the palette, picture of the labels, codebook, size of the palette."""
    count, terms = rest.shape[:2]
    size = min(max(count // _PALETTE_STEP, 1) * _PALETTE_STEP, _PALETTE_MAX)
    vectors, labels = palette(rest.reshape(count, 3 * terms), size)
    codes = codebook(vectors, _CODES)
    rows = -(-size // _PALETTE_ROW)
    centroids = np.zeros((rows * _PALETTE_ROW, terms, 4), np.uint8)
    centroids[: len(vectors), :, :3] = nearest(codes, vectors).reshape(-1, terms, 3)
    centroids[..., 3] = 255
    split = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1).astype(np.uint8)
    return centroids.reshape(rows, _PALETTE_ROW * terms, 4), _picture(split), codes, size


def _picture(
    rgb: NDArray[np.uint8],  # [N, 3]
    alpha: NDArray[np.uint8] | None = None,  # [N]; None: opaque
) -> ImageU8:
    """One pixel a Gaussian, row by row, in a picture [H, W, 4] whose sides are multiples of 4."""
    width = max(4, int(np.ceil(np.sqrt(len(rgb)) / 4)) * 4)
    height = max(4, -(-len(rgb) // (4 * width)) * 4)
    picture = np.full((height * width, 4), (0, 0, 0, 255), np.uint8)
    picture[: len(rgb), :3] = rgb
    if alpha is not None:
        picture[: len(rgb), 3] = alpha
    return picture.reshape(height, width, 4)


def _webp(picture: ImageU8) -> bytes:
    """Lossless, except for the colour where alpha is 0: of Gaussians that nobody sees."""
    done, content = cv2.imencode(
        ".webp", cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_WEBP_QUALITY, _LOSSLESS]
    )
    if not done:
        raise ValueError(f"no WebP of {picture.shape[1]}x{picture.shape[0]} pixels")
    return content.tobytes()


def codebook(values: NDArray[np.float32], size: int) -> NDArray[np.float32]:  # any shape -> [size]
    """``size`` ascending numbers near which the ``values`` lie: a `palette` of vectors with one part.

    Rounds of k-means after it lower the mean square error by 4 %.
    """
    found, _ = palette(values.reshape(-1, 1), size)
    return np.pad(np.sort(found[:, 0]), (0, size - len(found)), mode="edge")


def nearest(centres: NDArray[np.float32], values: NDArray[np.float32]) -> ImageU8:
    """Index of the nearest of up to 256 ascending ``centres`` for each value, in the shape of ``values``."""
    return np.searchsorted((centres[1:] + centres[:-1]) / 2, values).astype(np.uint8)


def palette(
    vectors: NDArray[np.float32],  # [N, D]
    size: int,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """At most ``size`` vectors [K, D], and which of them stands for each of the N (labels [N]).

    The group with the largest sum of squared deviations is split at its mean, along the axis on which it
    spreads most, until there are ``size`` groups. It costs N D log K, where k-means costs N D K a round.
    """
    groups = [np.arange(len(vectors))]
    waiting = [_spread(vectors, groups[0], 0)]
    while len(groups) < size and waiting[0][0] < 0.0:
        _, index, axis = heapq.heappop(waiting)
        members = groups[index]
        along = vectors[members, axis]
        above = along > along.mean(dtype=np.float64)
        groups[index] = members[~above]
        groups.append(members[above])
        for changed in (index, len(groups) - 1):
            heapq.heappush(waiting, _spread(vectors, groups[changed], changed))
    labels = np.empty(len(vectors), np.int64)
    for index, members in enumerate(groups):
        labels[members] = index
    return np.stack([vectors[members].mean(axis=0, dtype=np.float64) for members in groups]).astype(
        np.float32
    ), labels


def _spread(vectors: NDArray[np.float32], members: NDArray[np.int64], index: int) -> tuple[float, int, int]:
    """For the heap: minus the sum of squared deviations of a group, its index, its widest axis."""
    squares = vectors[members].var(axis=0, dtype=np.float64) * len(members)
    return -float(squares.sum()), index, int(squares.argmax())
