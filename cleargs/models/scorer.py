"""No-reference image scorers, which rate the quality of an image without the clean image.

RIVR uses two: the primary scorer chooses among candidates, the second one breaks near-ties (in the paper
MUSIQ and CLIP-IQA). The two that ClearGS includes predict ``100 - 100 x LPIPS`` to the unknown clean image: a
flawless image has 100, a frame with a blur of 4 to 12 px about 87.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cleargs.errors import InputError
from cleargs.models.naturalness import StatisticsScorer
from cleargs.models.onnx import OnnxModel
from cleargs.models.registry import Network, RegistryEntry, find_model, load_network
from cleargs.models.tiling import mean_over_tiles, require_scorable
from cleargs.types import Device, ImageF32

CLARITY = "clarity-net"
"""The embedded network, trained for the primary role."""
NATURALNESS = "naturalness-stats"
"""The embedded image statistics, for the tie-break role."""

_PATCH_SIDE = 128  # px; side of clarity-net's training patches

BLOCK = 16
"""Side of the blocks whose information is measured, px."""
_STEPS = 255.0  # number of steps of an 8-bit image between 0 and 1
_CLIPPED = 2.0  # values less than this many steps from black or white count as partly clipped
_MIN_UNCLIPPED = 0.5  # share of unclipped values with which a block counts fully, as highlights are normal
_FLAT, _TEXTURED = 0.5, 0.75  # standard deviation in a block, in steps; rounding alone causes up to 0.5

PATCH = 32
"""Side of MUSIQ's patches, px."""
_LONGER_SIDES = (224, 384)
_GRID = 10  # MUSIQ encodes positions on a grid with this number of cells per side


class Scorer(Network, Protocol):
    """A model that rates the quality of single images."""

    def score(self, image: ImageF32, *, threads: int = 1) -> float:
        """Return the score of an image [H, W, 3] sRGB in [0, 1]: 0-100, higher is better.

        Raises InputError if a side has less than 32 pixels. ``threads`` change no bit of the score.
        """


class InformedScorer:
    """A scorer whose score is clipped to 0-100 and multiplied by the share of the image with `information`.

    Scores on other scales, such as opinion scores of MUSIQ and those of a user's model, are clipped, too.
    """

    def __init__(self, scorer: Scorer) -> None:
        self.name, self.digest = scorer.name, scorer.digest
        self._scorer = scorer

    def score(self, image: ImageF32, *, threads: int = 1) -> float:
        """Return the score, as `Scorer.score`; raise InputError if the wrapped scorer returns no number."""
        value = self._scorer.score(image, threads=threads)
        if not math.isfinite(value):
            raise InputError(
                f"the scorer {self.name} returned {value} instead of a score",
                hint="use another scorer, or export its model again",
            )
        return min(max(value, 0.0), 100.0) * information(image)


def information(image: ImageF32) -> float:
    """Return the share of an image that is neither flat nor clipped, 0 to 1.

    In flat areas, and in areas clipped to black or white, a scorer has no evidence of the quality: a black
    frame could get a perfect score. Each block of 16 px counts by its unclipped values (fully from one half)
    and by its contrast (from a standard deviation of 1/2 of an 8-bit step, fully from 3/4). All limits are
    ramps, so the share is a continuous function of the image [H, W, 3]. It is close to 1 for normal frames
    (``weights/README.md``).
    """
    height, width = image.shape[:2]
    padded = np.pad(image, ((0, -height % BLOCK), (0, -width % BLOCK), (0, 0)), mode="symmetric")
    rows, columns = padded.shape[0] // BLOCK, padded.shape[1] // BLOCK
    blocks = padded.astype(np.float64).reshape(rows, BLOCK, columns, BLOCK, 3)
    from_the_ends = np.minimum(blocks, 1.0 - blocks) * (_STEPS / _CLIPPED)
    unclipped = np.clip(from_the_ends, 0.0, 1.0).mean(axis=(1, 3, 4))
    deviation = _STEPS * np.sqrt(blocks.var(axis=(1, 3)).mean(axis=2))
    texture = np.clip((deviation - _FLAT) / (_TEXTURED - _FLAT), 0.0, 1.0)
    return float((np.minimum(unclipped / _MIN_UNCLIPPED, 1.0) * texture).mean())


class LearnedScorer:
    """A scoring network in an ONNX file, which maps [N, 3, H, W] float32 sRGB in [0, 1] to N scores.

    ``name`` and ``device`` are those of an `OnnxExpert`. ``tile`` is the side of tiles whose mean is the
    score, px, so that the score depends little on the size of the image. None: the whole image, or tiles of
    the network's fixed input size. Raises InputError if the file is missing, is not an ONNX model, or has
    other inputs or outputs.
    """

    def __init__(
        self, path: Path, name: str | None = None, tile: int | None = None, device: Device = "cpu"
    ) -> None:
        model = OnnxModel(path, device)
        shape = model.inputs[0] if len(model.inputs) == 1 else ()
        takes_images = len(shape) == 4 and shape[0] in (None, 1) and shape[1] == 3
        if not takes_images or len(model.outputs[0]) > 2:
            raise InputError(
                f"{path} does not map an RGB image to one score: "
                f"it takes {model.inputs} and returns {model.outputs}",
                hint="use a scoring model that takes [N, 3, H, W] and returns one score per image",
            )
        self.name = name or path.stem
        self.digest = model.digest
        self._model = model
        self._tile = (shape[2] or tile, shape[3] or tile)

    def score(self, image: ImageF32, *, threads: int = 1) -> float:
        """Return the score on the scale of the network, as `Scorer.score`."""
        return mean_over_tiles(lambda tiles: self._model.map(self._score, tiles, threads), image, self._tile)

    def _score(self, tiles: ImageF32) -> ImageF32:
        """Return the scores [N] of tiles [N, h, w, 3]."""
        planes = np.ascontiguousarray(tiles.transpose(0, 3, 1, 2), np.float32)
        return self._model.run(planes)[0].reshape(len(tiles), -1)[:, 0]


class MusiqScorer:
    """MUSIQ (Ke et al., ICCV 2021) from an ONNX file: a transformer on patches of the image at three sizes.

    InputError is raised if the file is missing or its inputs are not those of `patches`.
    """

    name = "musiq"

    def __init__(self, path: Path, device: Device = "cpu") -> None:
        model = OnnxModel(path, device)
        if [len(shape) for shape in model.inputs] != [4, 1, 1]:
            raise InputError(
                f"{path} is not MUSIQ: its inputs are {model.inputs}",
                hint=f"{find_model('musiq').install_hint} again",
            )
        self.digest = model.digest
        self._model = model

    def score(self, image: ImageF32, *, threads: int = 1) -> float:
        """Return the predicted mean opinion score, about 0 to 100, as `Scorer.score`."""
        require_scorable(image)
        return float(self._model.run(*patches(image))[0].item())


def patches(image: ImageF32) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """Cut an image [H, W, 3] into patches as pyiqa does: at full size, and at longer sides of 224 and 384 px.

    Returns them [N, 3, 32, 32] in [-1, 1], their cells in the position grid [N], and indices of sizes [N].
    """
    import torch  # here, because it takes seconds and names of scorers must be available fast
    from torch.nn.functional import interpolate

    planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1), np.float32))[None] * 2.0 - 1.0
    height, width = image.shape[:2]
    sizes = []
    for side in _LONGER_SIDES:
        ratio = side / max(height, width)
        extent = (round(height * ratio), round(width * ratio))
        sizes.append(interpolate(planes, extent, mode="bicubic", align_corners=False))
    tiles, cells = zip(*(_cut(resized[0].numpy()) for resized in (*sizes, planes)), strict=True)
    scales = [np.full(len(those), number) for number, those in enumerate(cells)]
    return np.concatenate(tiles), np.concatenate(cells), np.concatenate(scales)


def _cut(planes: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the patches of an image [3, H, W], row by row, and their cells in the position grid.

    The image is padded with zeros on all sides; an odd pixel is added at the bottom or right.
    """
    height, width = planes.shape[1:]
    rows, columns = -(-height // PATCH), -(-width // PATCH)
    missing = (rows * PATCH - height, columns * PATCH - width)
    padded = np.pad(planes, ((0, 0), *((n // 2, n - n // 2) for n in missing)))
    grid = padded.reshape(3, rows, PATCH, columns, PATCH).transpose(1, 3, 0, 2, 4)
    cells = _cells(rows)[:, None] * _GRID + _cells(columns)[None, :]
    return np.ascontiguousarray(grid.reshape(-1, 3, PATCH, PATCH)), cells.ravel()


def _cells(count: int) -> NDArray[np.int64]:
    """Return the grid cell of each of ``count`` patches in a row, as torch's nearest neighbour in float32."""
    scale = np.float32(_GRID) / np.float32(count)
    cells = np.floor(np.arange(count, dtype=np.float32) * scale)
    return np.asarray(np.minimum(cells, _GRID - 1), np.int64)


def load_scorer(spec: str, device: Device = "cpu") -> Scorer:
    """Load the scorer that a setting names: a model of the registry, the path of an ONNX file, or a plugin.

    Raises InputError if it is unknown, not installed, damaged or unusable.
    """

    def from_file(path: Path, model: RegistryEntry | None) -> Scorer:
        if model is None:
            return LearnedScorer(path, device=device)
        if spec == NATURALNESS:
            return StatisticsScorer()
        if model.converter == "musiq":
            return MusiqScorer(path, device)
        return LearnedScorer(path, spec, _PATCH_SIDE if spec == CLARITY else None, device)

    return InformedScorer(load_network(spec, "scorer", device, from_file))
