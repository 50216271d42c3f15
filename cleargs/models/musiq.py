"""MUSIQ (Ke et al., ICCV 2021): a transformer on patches of the image at three sizes, without cropping it.

The ONNX network takes patches and their places; cutting the image up is done here, as pyiqa does it: at its
own size and reduced or enlarged to longer sides of 224 and 384 pixels, whatever its shape.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from cleargs.errors import InputError
from cleargs.models.onnx import Device, OnnxModel
from cleargs.models.registry import find_model
from cleargs.models.tiling import Image, require_scorable

PATCH = 32
"""Side of a patch in pixels."""

_LONGER_SIDES = (224, 384)
_GRID = 10  # positions are told apart on a grid of this many cells a side


class MusiqScorer:
    """MUSIQ from an ONNX file: patches [N, 3, 32, 32], places [N] and sizes [N] in, one score out.

    Raises InputError when the file is missing or of another form.
    """

    def __init__(self, path: Path, name: str = "musiq", device: Device = "cpu") -> None:
        model = OnnxModel(path, device)
        if [len(info.shape) for info in model.inputs] != [4, 1, 1]:
            raise InputError(
                f"{path} is not MUSIQ: its inputs are {[info.shape for info in model.inputs]}",
                hint=f"{find_model('musiq').install_hint} again",
            )
        self.name = name
        self.digest = model.digest
        self._model = model

    def score(self, image: Image, *, threads: int = 1) -> float:
        """The predicted mean opinion score, about 0 to 100. See Scorer."""
        require_scorable(image)
        return float(self._model.run(*patches(image))[0].item())


def patches(image: Image) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """The patches [N, 3, 32, 32] of an sRGB image in [0, 1], in [-1, 1]; cells of the position grid [N] and
    numbers of the sizes [N]."""
    planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1), np.float32))[None] * 2.0 - 1.0
    height, width = image.shape[:2]
    sizes = []
    for side in _LONGER_SIDES:
        ratio = side / max(height, width)
        extent = (round(height * ratio), round(width * ratio))
        sizes.append(functional.interpolate(planes, extent, mode="bicubic", align_corners=False))
    cut = [_cut(resized[0].numpy()) for resized in (*sizes, planes)]
    scales = [np.full(len(places), number) for number, (_, places) in enumerate(cut)]
    return (
        np.concatenate([tiles for tiles, _ in cut]),
        np.concatenate([places for _, places in cut]),
        np.concatenate(scales),
    )


def _cut(planes: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Patches of an image [3, H, W], row by row, and the cells of the position grid that they lie in.

    The image is padded evenly by zeros, the odd pixel below and right.
    """
    height, width = planes.shape[1:]
    rows, columns = -(-height // PATCH), -(-width // PATCH)
    missing = (rows * PATCH - height, columns * PATCH - width)
    padded = np.pad(planes, ((0, 0), *((n // 2, n - n // 2) for n in missing)))
    grid = padded.reshape(3, rows, PATCH, columns, PATCH).transpose(1, 3, 0, 2, 4)
    places = _cells(rows)[:, None] * _GRID + _cells(columns)[None, :]
    return np.ascontiguousarray(grid.reshape(-1, 3, PATCH, PATCH)), places.ravel()


def _cells(count: int) -> NDArray[np.int64]:
    """The grid cell of each of ``count`` patches in a row: torch's nearest neighbour, in float32 as there."""
    scale = np.float32(_GRID) / np.float32(count)
    cells = np.floor(np.arange(count, dtype=np.float32) * scale)
    return np.asarray(np.minimum(cells, _GRID - 1), np.int64)
