"""No-reference image scorers: how good does an image look, judged without the clean one.

RIVR asks two of them: the primary one decides between candidates, the other breaks near-ties (the paper uses
MUSIQ and CLIP-IQA). The two that ship with ClearGS were trained for it and bear their own names.

Both embedded scores are ``100 - 100 x (predicted LPIPS to the unseen clean image)``: 100 is flawless, a
frame with 4-12 px of blur lies near 87. Every score of `load_scorer` lies in 0-100 and is multiplied by the
share of the image that carries information (`information`).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cleargs.errors import InputError
from cleargs.models.naturalness import StatisticsScorer
from cleargs.models.onnx import Device, OnnxModel
from cleargs.models.registry import RegistryEntry, find_model, load_network
from cleargs.models.tiling import mean_over_tiles, require_scorable
from cleargs.types import ImageF32

CLARITY = "clarity-net"
"""The embedded network, meant for the primary role."""
NATURALNESS = "naturalness-stats"
"""The embedded image statistics, meant for the tie-break role."""

_TRAINED_ON = 128  # the side of clarity-net's training patches

BLOCK = 16
"""Side of the blocks whose information is judged one by one, px."""
_STEPS = 255.0
"""Of an 8-bit image, in [0, 1]."""
_CLIPPED = 2.0  # steps from black or white up to which a value counts as clipped, in part
_ENOUGH = 0.5  # a block counts in full while so many of its values are not clipped: highlights are no fault
_FLAT, _TEXTURED = 0.5, 0.75  # steps of deviation inside a block; rounding alone makes up to 0.5

PATCH = 32
"""Side of MUSIQ's patches, px."""
_LONGER_SIDES = (224, 384)
_GRID = 10  # MUSIQ tells positions apart on a grid of this many cells a side


class Scorer(Protocol):
    """Judges single images."""

    @property
    def name(self) -> str:
        """A short name for tables."""

    @property
    def digest(self) -> str:
        """Identifies the weights; part of the store key."""

    def score(self, image: ImageF32, *, threads: int = 1) -> float:
        """0-100, higher is better; bitwise equal for any ``threads``.

        image: [H, W, 3] float32 sRGB in [0, 1], at least 32 pixels on each side. Raises InputError for any
        other.
        """


class InformedScorer:
    """What another scorer says, cut to 0-100, times the share of the image that carries information.

    A black, white or flat image gets 0, and a frame loses as much of its score as is clipped away. What
    MUSIQ says in opinion scores and a file of the user's in any unit is cut as well.
    """

    def __init__(self, scorer: Scorer) -> None:
        self.name, self.digest = scorer.name, scorer.digest
        self._scorer = scorer

    def score(self, image: ImageF32, *, threads: int = 1) -> float:
        """See Scorer. Raises InputError, too, when the other scorer gives no number."""
        value = self._scorer.score(image, threads=threads)
        if not math.isfinite(value):
            raise InputError(
                f"the scorer {self.name} gave {value} instead of a score",
                hint="use another scorer, or export its model again",
            )
        return min(max(value, 0.0), 100.0) * information(image)


def information(image: ImageF32) -> float:
    """The share of an image [H, W, 3], float32 sRGB in [0, 1], that is neither flat nor clipped: 0 to 1.

    A scorer guesses the quality of what it sees. Where an image is flat, or clipped to black or white, there
    is nothing to see: a guess made there stands on no evidence, and a black frame may well look flawless.

    Each block of 16 px counts by its values that are not clipped, in full from one half on, and by its
    contrast, in full from 3/4 of an 8-bit step of standard deviation on. All limits are ramps, so the
    share changes continuously with the image. It is close to 1 for ordinary frames (``weights/README.md`` has
    figures).
    """
    height, width = image.shape[:2]
    padded = np.pad(image, ((0, -height % BLOCK), (0, -width % BLOCK), (0, 0)), mode="symmetric")
    rows, columns = padded.shape[0] // BLOCK, padded.shape[1] // BLOCK
    blocks = padded.astype(np.float64).reshape(rows, BLOCK, columns, BLOCK, 3)
    to_the_end = np.minimum(blocks, 1.0 - blocks) * (_STEPS / _CLIPPED)
    unclipped = np.clip(to_the_end, 0.0, 1.0).mean(axis=(1, 3, 4))
    deviation = _STEPS * np.sqrt(blocks.var(axis=(1, 3)).mean(axis=2))
    texture = np.clip((deviation - _FLAT) / (_TEXTURED - _FLAT), 0.0, 1.0)
    return float((np.minimum(unclipped / _ENOUGH, 1.0) * texture).mean())


class LearnedScorer:
    """A scoring network in an ONNX file: [N, 3, H, W] float32 sRGB in [0, 1] in, one score an image out, of
    whatever scale the network has.

    With ``tile``, or where the model fixes its input size, the score is the mean over tiles of that side:
    LPIPS is a mean over pixels too, so the score of an image then hardly depends on its size. Otherwise the
    model sees the image at once.

    Raises InputError when the file is missing, no ONNX model, or of another form.
    """

    def __init__(
        self, path: Path, name: str | None = None, tile: int | None = None, device: Device = "cpu"
    ) -> None:
        model = OnnxModel(path, device)
        shape = model.inputs[0].shape if len(model.inputs) == 1 else ()
        takes_images = len(shape) == 4 and shape[0] in (None, 1) and shape[1] == 3
        if not takes_images or len(model.outputs[0].shape) > 2:
            raise InputError(
                f"{path} does not turn an RGB image into one score: "
                f"it takes {[i.shape for i in model.inputs]} and returns {[o.shape for o in model.outputs]}",
                hint="a scoring model takes [N, 3, H, W] and returns one score an image",
            )
        self.name = name or path.stem
        self.digest = model.digest
        self._model = model
        self._tile = (shape[2] or tile, shape[3] or tile)

    def score(self, image: ImageF32, *, threads: int = 1) -> float:
        """See Scorer."""
        return mean_over_tiles(lambda tiles: self._model.map(self._score, tiles, threads), image, self._tile)

    def _score(self, tiles: ImageF32) -> ImageF32:
        """The scores [N] of tiles [N, h, w, 3]."""
        planes = np.ascontiguousarray(tiles.transpose(0, 3, 1, 2), np.float32)
        return self._model.run(planes)[0].reshape(len(tiles), -1)[:, 0]


class MusiqScorer:
    """MUSIQ (Ke et al., ICCV 2021) from an ONNX file: a transformer on patches of the image at three sizes.

    Patches [N, 3, 32, 32], places [N] and sizes [N] in, one score out. Cutting the image up is done here, as
    pyiqa does it: at its own size and reduced or enlarged to longer sides of 224 and 384 pixels.

    Raises InputError when the file is missing or of another form.
    """

    name = "musiq"

    def __init__(self, path: Path, device: Device = "cpu") -> None:
        model = OnnxModel(path, device)
        if [len(info.shape) for info in model.inputs] != [4, 1, 1]:
            raise InputError(
                f"{path} is not MUSIQ: its inputs are {[info.shape for info in model.inputs]}",
                hint=f"{find_model('musiq').install_hint} again",
            )
        self.digest = model.digest
        self._model = model

    def score(self, image: ImageF32, *, threads: int = 1) -> float:
        """The predicted mean opinion score, about 0 to 100. See Scorer."""
        require_scorable(image)
        return float(self._model.run(*patches(image))[0].item())


def patches(image: ImageF32) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """The patches [N, 3, 32, 32] of an sRGB image in [0, 1], in [-1, 1]; cells of the position grid [N] and
    numbers of the sizes [N].
    """
    import torch  # seconds, which naming a scorer must not take
    from torch.nn.functional import interpolate

    planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1), np.float32))[None] * 2.0 - 1.0
    height, width = image.shape[:2]
    sizes = []
    for side in _LONGER_SIDES:
        ratio = side / max(height, width)
        extent = (round(height * ratio), round(width * ratio))
        sizes.append(interpolate(planes, extent, mode="bicubic", align_corners=False))
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


def load_scorer(spec: str, device: Device = "cpu") -> Scorer:
    """The scorer that a setting names: ``clarity-net``, ``naturalness-stats``, one of the registry that is
    installed, the path of an ONNX file, or one that another package brings; networks on what `network_device`
    found.

    Raises InputError for any other name, an unusable file or an installed one that was changed.
    """

    def own(path: Path, model: RegistryEntry | None) -> Scorer:
        if model is None:
            return LearnedScorer(path, device=device)
        if spec == NATURALNESS:
            return StatisticsScorer()
        if model.converter == "musiq":
            return MusiqScorer(path, device)
        return LearnedScorer(path, spec, _TRAINED_ON if spec == CLARITY else None, device)

    return InformedScorer(load_network(spec, "scorer", device, own))
