"""No-reference image scorers: how good does an image look, judged without the clean one.

RIVR asks two of them: the primary one decides between candidates, the other breaks near-ties (the paper uses
MUSIQ and CLIP-IQA). The two that ship with ClearGS were trained for it and bear their own names.

Both embedded scores are ``100 - 100 x (predicted LPIPS to the unseen clean image)``: 100 is flawless, a
frame with 4-12 px of blur lies near 87. Every score of `load_scorer` lies in 0-100 and is multiplied by the
share of the image that carries information (`cleargs.models.information`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Protocol

import numpy as np

from cleargs.errors import InputError, did_you_mean
from cleargs.models.batches import in_batches
from cleargs.models.information import information
from cleargs.models.naturalness import COEFFICIENTS, StatisticsScorer
from cleargs.models.onnx import Device, OnnxModel
from cleargs.models.registry import installable, installed_file, load_registry, verify
from cleargs.models.tile_mean import Image, cover, mean_over_tiles
from cleargs.plugins import load_part, plugins

CLARITY = "clarity-net"
"""The embedded network, meant for the primary role."""
NATURALNESS = "naturalness-stats"
"""The embedded image statistics, meant for the tie-break role."""

_TRAINED_ON = 128  # the side of clarity-net's training patches


class Scorer(Protocol):
    """Judges single images."""

    @property
    def name(self) -> str:
        """A short name for tables."""

    @property
    def digest(self) -> str:
        """Identifies the weights; part of the store key."""

    def score(self, image: Image, *, threads: int = 1) -> float:
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
        self._scorer = scorer

    @property
    def name(self) -> str:
        """Of the other scorer."""
        return self._scorer.name

    @property
    def digest(self) -> str:
        """Of the other scorer's weights."""
        return self._scorer.digest

    def score(self, image: Image, *, threads: int = 1) -> float:
        """See Scorer. Raises InputError, too, when the other scorer gives no number."""
        said = self._scorer.score(image, threads=threads)
        if not math.isfinite(said):
            raise InputError(
                f"the scorer {self.name} gave {said} instead of a score",
                hint="use another scorer, or export its model again",
            )
        return min(max(said, 0.0), 100.0) * information(image)


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
        self._model = model
        self._batches = model.takes_batches
        self._tile = (shape[2] or tile, shape[3] or tile)

    @property
    def digest(self) -> str:
        """SHA-256 of the ONNX file."""
        return self._model.digest

    def score(self, image: Image, *, threads: int = 1) -> float:
        """See Scorer."""
        if self._batches:
            tiles = cover(image, self._tile)
            height, width = tiles[0].shape[:2]
            scores = in_batches(self._score_batch, tiles, height * width)
            return float(np.mean(scores, dtype=np.float64))
        calls = 1 if self._model.device == "cuda" else threads
        return mean_over_tiles(self._score_tile, image, self._tile, calls)

    def _score_tile(self, tile: Image) -> float:
        return float(self._score_batch(tile[None])[0])

    def _score_batch(self, tiles: Image) -> Image:
        """The scores [N] of tiles [N, h, w, 3]."""
        planes = np.ascontiguousarray(tiles.transpose(0, 3, 1, 2), np.float32)
        return self._model.run(planes)[0].reshape(len(tiles), -1)[:, 0]


def scorer_path(spec: str) -> Path | None:
    """The file, absolute, that holds the weights of the scorer that a setting names.

    Its content stands for the scorer in the keys of the store; None for a scorer that another package brings,
    whose version does. A path need not exist; raises InputError for any other name, and when a scorer of the
    registry is not installed.
    """
    models = Path(str(files("cleargs.models"))).absolute()
    if spec == CLARITY:
        return models / "weights" / "scorer.onnx"
    if spec == NATURALNESS:
        return models / COEFFICIENTS
    if spec.endswith(".onnx"):
        return Path(spec).absolute()
    path = installed_file(spec, "scorer")
    if path is None and spec not in (brought := plugins("scorers")):
        known = [*(model.name for model in load_registry() if model.role == "scorer"), *brought]
        raise InputError(
            f"no scorer is called {spec!r}",
            hint=did_you_mean(spec, known, f"choose {', '.join(known)}, or give an ONNX file"),
        )
    return path


def load_scorer(spec: str, device: Device = "cpu") -> Scorer:
    """The scorer that a setting names: ``clarity-net``, ``naturalness-stats``, one of the registry that is
    installed, the path of an ONNX file, or one that another package brings; networks on what `network_device`
    found.

    Raises InputError for any other name, an unusable file or an installed one that was changed.
    """
    return InformedScorer(_load(spec, device))


def _load(spec: str, device: Device) -> Scorer:
    path = scorer_path(spec)
    if path is None:
        maker: Callable[[Device], Scorer] = load_part("scorers", spec)
        return maker(device)
    if spec == NATURALNESS:
        return StatisticsScorer(NATURALNESS)
    if model := installable(spec, "scorer"):
        verify(model, path.parent)
        if model.converter == "musiq":
            from cleargs.models.musiq import MusiqScorer  # torch, which naming a scorer must not import

            return MusiqScorer(path, spec, device)
        return LearnedScorer(path, spec, device=device)
    if spec == CLARITY:
        return LearnedScorer(path, CLARITY, _TRAINED_ON, device)
    return LearnedScorer(path, device=device)
