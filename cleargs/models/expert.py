"""The frozen restoration expert of RIVR: it maps an image to a sharper image of the same size.

Any restoration network in an ONNX file can be used, of a fixed or free input size. The embedded default
was trained by `tools/train_models/train_restorer.py`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np

from cleargs.errors import InputError, StageError
from cleargs.models.onnx import OnnxModel
from cleargs.models.registry import Network, RegistryEntry, load_network
from cleargs.models.tiling import map_tiled
from cleargs.types import Device, ImageF32


class Expert(Network, Protocol):
    """A frozen image restorer."""

    def restore(self, image: ImageF32, *, threads: int = 1) -> ImageF32:
        """Restore an image [H, W, 3] float32 sRGB in [0, 1]; ``threads`` does not change any bit."""


class OnnxExpert:
    """A restoration network in an ONNX file, applied to overlapping tiles (on a GPU in batches).

    The network maps an image [1, 3, H, W], float32 sRGB in [0, 1], to an image of the same size. Its first
    output is used. A fixed input size is the size of the tiles. ``name`` is for tables (None: the file name
    without its extension); ``device`` is a result of `network_device`. Raises InputError if the file is
    missing, is not an ONNX model, or has other inputs.
    """

    def __init__(self, path: Path, name: str | None = None, device: Device = "cpu") -> None:
        model = OnnxModel(path, device)
        shape = model.inputs[0] if len(model.inputs) == 1 else ()
        if len(shape) != 4 or shape[0] not in (None, 1) or shape[1] != 3:
            raise InputError(
                f"{path} does not take one RGB image: its inputs are {model.inputs}",
                hint="use a restoration model that takes [1, 3, H, W]",
            )
        if not model.takes_floats:
            raise InputError(f"{path} does not take float32 values", hint="export the model in float32")
        self._model = model
        self._fixed = (shape[2], shape[3])
        self.name = name or path.stem
        self.digest = model.digest

    def restore(self, image: ImageF32, *, threads: int = 1) -> ImageF32:
        """Restore an image, as `Expert.restore`; raise StageError if the result is not finite."""
        restored = map_tiled(
            lambda tiles: self._model.map(self._restore, tiles, threads), image, fixed=self._fixed
        )
        if not np.isfinite(restored).all():
            raise StageError(
                f"the restoration expert {self.name} returned values that are not finite",
                hint="check the model file, or set rivr.expert to another model",
            )
        return np.clip(restored, np.float32(0.0), np.float32(1.0))

    def _restore(self, tiles: ImageF32) -> ImageF32:
        """Restore tiles [N, h, w, 3]."""
        batch = np.ascontiguousarray(tiles.transpose(0, 3, 1, 2), np.float32)
        output = self._model.run(batch)[0]
        if output.shape != batch.shape:
            raise InputError(
                f"the restoration expert {self.name} maps {batch.shape} to {output.shape}",
                hint="use a restoration model that returns an image of the same size",
            )
        return np.asarray(output.transpose(0, 2, 3, 1), np.float32)


def load_expert(spec: str, device: Device = "cpu") -> Expert:
    """Load the expert that ``rivr.expert`` names: a model of the registry, an ONNX file, or a plugin.

    Raises InputError if it is unknown, not installed or unusable.
    """

    def from_file(path: Path, model: RegistryEntry | None) -> Expert:
        return OnnxExpert(path, None if model is None else spec, device)

    return load_network(spec, "expert", device, from_file)
