"""``.sog``, PlayCanvas's scenes for the web: a zip of lossless WebP images with one Gaussian per pixel.

- Positions: 16 bits of sign(x) log(1 + |x|), in two images.
- Quaternions: three components of 8 bits, and the index of the largest component.
- Log scales and colours: indices into codebooks of 256 numbers. Opacities: 8 bits.
- Spherical harmonics above degree 0: an index into a palette of vectors, whose components are indices into a
  third codebook.

Source: version 2 of the format, as splat-transform reads and writes it.
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

from cleargs.safe_io import MAX_BYTES
from cleargs.splat.compressed_ply import LOG_SCALE_MAX, morton_order, smallest_three, whole_quaternions
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.types import ImageU8

_CODES = 256
_PALETTE_MAX = 65536  # labels have 16 bits
_PALETTE_STEP = 1024  # the size of a palette is a multiple of this
_PALETTE_ROW = 64  # vectors per row of the palette's image
_LOSSLESS = 101  # OpenCV: qualities above 100 are lossless
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)  # the earliest date of zip; constant, so that equal scenes give equal bytes


def sog(scene: Scene) -> bytes:
    """Encode a scene, with its Gaussians in Morton order; equal scenes give equal bytes."""
    gaussians = scene.gaussians.to("cpu").detach()
    gaussians = gaussians.select(torch.from_numpy(morton_order(gaussians.means.numpy())))
    count, sh = gaussians.num, gaussians.sh.numpy()
    images: dict[str, ImageU8] = {}

    means = gaussians.means.numpy().astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(axis=0), logs.max(axis=0)
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1.0) * 65535.0).astype(np.uint16)
    images["means_l"] = _image((steps & 255).astype(np.uint8))
    images["means_u"] = _image((steps >> 8).astype(np.uint8))

    largest, smaller = smallest_three(gaussians.rotations.numpy())
    parts = np.rint((smaller * np.sqrt(2.0) * 0.5 + 0.5) * 255.0).astype(np.uint8)
    images["quats"] = _image(parts, (252 + largest).astype(np.uint8))

    log_scales = gaussians.log_scales.numpy().clip(-LOG_SCALE_MAX, LOG_SCALE_MAX)
    scales = codebook(log_scales, _CODES)
    images["scales"] = _image(nearest(scales, log_scales))
    colours = codebook(sh[:, 0], _CODES)
    alpha = np.rint(torch.sigmoid(gaussians.logit_opacities).numpy() * 255.0).astype(np.uint8)
    images["sh0"] = _image(nearest(colours, sh[:, 0]), alpha)

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
        images["shN_centroids"], images["shN_labels"], codes, size = _harmonics(sh[:, 1:])
        meta["shN"] = {
            "count": size,
            "bands": gaussians.sh_degree,
            "codebook": codes.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo("meta.json", _ZIP_DATE), json.dumps(meta))
        for name, image in images.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.webp", _ZIP_DATE), _webp(image))
    return content.getvalue()


def from_sog(content: bytes) -> Scene:
    """Decode a scene of version 2. Raises a fault of the decoders if it is another file."""
    archive = zipfile.ZipFile(io.BytesIO(content))
    if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
        raise ValueError("it is too large")
    meta = json.loads(archive.read("meta.json"))
    if meta.get("version") != 2:
        raise ValueError("not a .sog of version 2")
    count = int(meta["count"])

    def image(part: str, index: int = 0) -> ImageU8:  # [H, W, 4]
        found = cv2.imdecode(
            np.frombuffer(archive.read(meta[part]["files"][index]), np.uint8), cv2.IMREAD_UNCHANGED
        )
        if found is None or found.ndim != 3:
            raise ValueError(f"its image of {part} cannot be decoded")
        order = cv2.COLOR_BGRA2RGBA if found.shape[2] == 4 else cv2.COLOR_BGR2RGBA
        return np.asarray(cv2.cvtColor(found, order), np.uint8)

    def pixels(part: str, index: int = 0) -> ImageU8:  # [N, 4]
        return image(part, index).reshape(-1, 4)[:count]

    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    steps = pixels("means")[:, :3] + 256.0 * pixels("means", 1)[:, :3]
    logs = low + steps / 65535.0 * (high - low)
    quaternions, colours = pixels("quats"), pixels("sh0")
    sh = np.array(meta["sh0"]["codebook"])[colours[:, None, :3]]
    if meta.get("shN"):
        codes = np.array(meta["shN"]["codebook"])[image("shN")[..., :3]]
        labels = pixels("shN", 1)[:, :2] @ np.array([1, 256])
        sh = np.concatenate([sh, codes.reshape(-1, codes.shape[1] // _PALETTE_ROW, 3)[labels]], axis=1)
    tensors = {
        "means": np.sign(logs) * np.expm1(np.abs(logs)),
        "log_scales": np.array(meta["scales"]["codebook"])[pixels("scales")[:, :3]],
        "rotations": whole_quaternions(
            quaternions[:, 3] - np.uint8(252), (quaternions[:, :3] / 127.5 - 1.0) * np.sqrt(0.5)
        ),
        "logit_opacities": torch.logit(torch.from_numpy(colours[:, 3] / 255.0)).numpy(),
        "sh": sh,
    }
    gaussians = Gaussians(
        **{name: torch.from_numpy(tensor.astype(np.float32)) for name, tensor in tensors.items()}
    )
    return Scene(gaussians.bounded(), antialias=meta.get("model") == "antialiased")


def _harmonics(
    rest: NDArray[np.float32],  # [N, K - 1, 3]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32], int]:
    """Return the image of the palette, the image of the labels, the codebook, and the size of the palette."""
    count, terms = rest.shape[:2]
    size = min(max(count // _PALETTE_STEP, 1) * _PALETTE_STEP, _PALETTE_MAX)
    vectors, labels = palette(rest.reshape(count, 3 * terms), size)
    codes = codebook(vectors, _CODES)
    rows = -(-size // _PALETTE_ROW)
    centroids = np.zeros((rows * _PALETTE_ROW, terms, 4), np.uint8)
    centroids[: len(vectors), :, :3] = nearest(codes, vectors).reshape(-1, terms, 3)
    centroids[..., 3] = 255
    split = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1).astype(np.uint8)
    return centroids.reshape(rows, _PALETTE_ROW * terms, 4), _image(split), codes, size


def _image(
    rgb: NDArray[np.uint8],  # [N, 3]
    alpha: NDArray[np.uint8] | None = None,  # [N]; None: opaque
) -> ImageU8:
    """Return an image [H, W, 4] with one Gaussian per pixel, row by row; its sides are multiples of 4."""
    width = max(4, int(np.ceil(np.sqrt(len(rgb)) / 4)) * 4)
    height = max(4, -(-len(rgb) // (4 * width)) * 4)
    image = np.full((height * width, 4), (0, 0, 0, 255), np.uint8)
    image[: len(rgb), :3] = rgb
    if alpha is not None:
        image[: len(rgb), 3] = alpha
    return image.reshape(height, width, 4)


def _webp(image: ImageU8) -> bytes:
    """Encode an image without loss, except colours with alpha 0 (invisible Gaussians)."""
    done, content = cv2.imencode(
        ".webp", cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_WEBP_QUALITY, _LOSSLESS]
    )
    if not done:
        raise ValueError(f"OpenCV cannot encode {image.shape[1]}x{image.shape[0]} pixels as WebP")
    return content.tobytes()


def codebook(values: NDArray[np.float32], size: int) -> NDArray[np.float32]:  # any shape -> [size]
    """Return ``size`` ascending numbers that approximate ``values``: a `palette` in one dimension."""
    found, _ = palette(values.reshape(-1, 1), size)
    return np.pad(np.sort(found[:, 0]), (0, size - len(found)), mode="edge")


def nearest(centres: NDArray[np.float32], values: NDArray[np.float32]) -> ImageU8:
    """Return the index of the nearest of up to 256 ascending ``centres`` for each of the ``values``."""
    return np.searchsorted((centres[1:] + centres[:-1]) / 2, values).astype(np.uint8)


def palette(
    vectors: NDArray[np.float32],  # [N, D]
    size: int,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:  # [K, D], [N]
    """Return K <= ``size`` vectors, and for each of the N vectors the index of the one that replaces it.

    The group with the largest sum of squared deviations is split at its mean, along the axis with the largest
    variance, until there are ``size`` groups: N D log K operations, where a round of k-means costs N D K.
    """
    groups = [np.arange(len(vectors))]
    heap = [_spread(vectors, groups[0], 0)]
    while len(groups) < size and heap[0][0] < 0.0:
        _, index, axis = heapq.heappop(heap)
        members = groups[index]
        along = vectors[members, axis]
        above = along > along.mean(dtype=np.float64)
        groups[index] = members[~above]
        groups.append(members[above])
        for changed in (index, len(groups) - 1):
            heapq.heappush(heap, _spread(vectors, groups[changed], changed))
    labels = np.empty(len(vectors), np.int64)
    for index, members in enumerate(groups):
        labels[members] = index
    means = np.stack([vectors[members].mean(axis=0, dtype=np.float64) for members in groups])
    return means.astype(np.float32), labels


def _spread(vectors: NDArray[np.float32], members: NDArray[np.int64], index: int) -> tuple[float, int, int]:
    """Return the heap entry of a group: minus its sum of squared deviations, its index, its widest axis."""
    squares = vectors[members].var(axis=0, dtype=np.float64) * len(members)
    return -float(squares.sum()), index, int(squares.argmax())
