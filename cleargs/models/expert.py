"""The frozen restoration expert of RIVR: an image in, a sharper image of the same size out.

Any ONNX restoration network serves: NCHW or NHWC, fixed or free size. The embedded default is the network of
`tools/train_models/train_restorer.py`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np

from cleargs.errors import InputError, StageError
from cleargs.models.onnx import Device, OnnxModel
from cleargs.models.registry import RegistryEntry, load_network
from cleargs.models.tiling import map_tiled
from cleargs.types import ImageF32


class Expert(Protocol):
    """A frozen image restorer."""

    @property
    def name(self) -> str:
        """A short name for tables."""

    @property
    def digest(self) -> str:
        """Identifies the weights; part of the store key."""

    def restore(self, image: ImageF32, *, threads: int = 1) -> ImageF32:
        """The restored image, of the same bits for any ``threads``: [H, W, 3] float32 sRGB in [0, 1]."""


class OnnxExpert:
    """A restoration network in an ONNX file, run on overlapping tiles: on a GPU on several at a time.

    The model takes one image as [1, 3, H, W] or [1, H, W, 3] float32 in [0, 1] and returns one of the same
    size in either layout; of several outputs the first counts. Sides that the model fixes become the tiles'.

    Raises InputError when the file is missing, no ONNX model, or of another form.
    """

    def __init__(self, path: Path, name: str | None = None, device: Device = "cpu") -> None:
        model = OnnxModel(path, device)
        shape = model.inputs[0].shape if len(model.inputs) == 1 else ()
        if len(shape) != 4 or shape[0] not in (None, 1) or 3 not in (shape[1], shape[3]):
            raise InputError(
                f"{path} does not take one RGB image: its inputs are {[info.shape for info in model.inputs]}",
                hint="a restoration model takes [1, 3, H, W] or [1, H, W, 3]",
            )
        if model.inputs[0].dtype != "float":
            raise InputError(
                f"{path} takes {model.inputs[0].dtype} values, not float32",
                hint="export the model in float32",
            )
        self._model = model
        self._channels_first = shape[1] == 3
        self._fixed = (shape[2], shape[3]) if self._channels_first else (shape[1], shape[2])
        self.name = name or path.stem
        self.digest = model.digest

    def restore(self, image: ImageF32, *, threads: int = 1) -> ImageF32:
        """See `Expert.restore`. Raises StageError when the model returns values that are not finite."""
        restored = map_tiled(
            lambda tiles: self._model.map(self._restore, tiles, threads), image, fixed=self._fixed
        )
        if not np.isfinite(restored).all():
            raise StageError(
                f"the restoration expert {self.name} returned values that are not finite",
                hint="check the model file, or set rivr.expert to another one",
            )
        return np.clip(restored, np.float32(0.0), np.float32(1.0))

    def _restore(self, tiles: ImageF32) -> ImageF32:
        """Tiles [N, h, w, 3], restored."""
        batch = tiles.transpose(0, 3, 1, 2) if self._channels_first else tiles
        output = self._model.run(np.ascontiguousarray(batch, np.float32))[0]
        restored = output.transpose(0, 2, 3, 1) if output.ndim == 4 and output.shape[1] == 3 else output
        if restored.shape != tiles.shape:
            raise InputError(
                f"the restoration expert {self.name} maps {tiles.shape} to {output.shape}",
                hint="a restoration model returns an image of the same size",
            )
        return np.asarray(restored, np.float32)


def load_expert(spec: str, device: Device = "cpu") -> Expert:
    """The expert named by ``spec`` (see `load_network`), on what `network_device` found. Raises InputError,
    also as `OnnxExpert` does.
    """

    def own(path: Path, model: RegistryEntry | None) -> Expert:
        return OnnxExpert(path, None if model is None else spec, device)

    return load_network(spec, "expert", device, own)
