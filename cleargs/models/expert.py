"""The frozen restoration expert of RIVR: an image in, a sharper image of the same size out.

Any ONNX restoration network serves: NCHW or NHWC, fixed or free size. The embedded default is the network of
`cleargs.models.training.restorer`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Protocol

import numpy as np

from cleargs.errors import InputError, StageError
from cleargs.models.installed import installable, installed_file, verify
from cleargs.models.onnx import OnnxModel
from cleargs.models.tiling import Image, apply_tiled

EMBEDDED = "embedded"
"""The name under which settings ask for the expert that ships with ClearGS."""


class Expert(Protocol):
    """A frozen image restorer."""

    @property
    def name(self) -> str:
        """A short name for tables."""

    @property
    def digest(self) -> str:
        """Identifies the weights; part of the store key."""

    def restore(
        self, image: Image, *, threads: int = 1, on_tile: Callable[[int, int], None] | None = None
    ) -> Image:
        """The restored image: [H, W, 3] float32 sRGB in [0, 1] in and out, bitwise equal for any ``threads``.

        on_tile: called with (done, total) as the work proceeds.
        """


class OnnxExpert:
    """A restoration network in an ONNX file, run on overlapping tiles.

    The model takes one image as [1, 3, H, W] or [1, H, W, 3] float32 in [0, 1] and returns one of the same
    size in either layout; of several outputs the first counts. Sides that the model fixes become the tiles'.

    Raises InputError when the file is missing, no ONNX model, or of another form.
    """

    def __init__(self, path: Path, name: str | None = None) -> None:
        model = OnnxModel(path)
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

    @property
    def digest(self) -> str:
        """SHA-256 of the ONNX file in hexadecimal."""
        return self._model.digest

    def restore(
        self, image: Image, *, threads: int = 1, on_tile: Callable[[int, int], None] | None = None
    ) -> Image:
        """See `Expert.restore`. Raises StageError when the model returns values that are not finite."""
        restored = apply_tiled(self._restore_tile, image, fixed=self._fixed, threads=threads, on_tile=on_tile)
        if not np.isfinite(restored).all():
            raise StageError(
                f"the restoration expert {self.name} returned values that are not finite",
                hint="check the model file, or set rivr.expert to another one",
            )
        return np.clip(restored, np.float32(0.0), np.float32(1.0))

    def _restore_tile(self, tile: Image) -> Image:
        batch = tile.transpose(2, 0, 1)[None] if self._channels_first else tile[None]
        output = self._model.run(np.ascontiguousarray(batch, np.float32))[0]
        restored = output[0].transpose(1, 2, 0) if output.ndim == 4 and output.shape[1] == 3 else output[0]
        if restored.shape != tile.shape:
            raise InputError(
                f"the restoration expert {self.name} maps {tile.shape} to {output.shape}",
                hint="a restoration model returns an image of the same size",
            )
        return np.asarray(restored, np.float32)


def expert_path(spec: str) -> Path:
    """The ONNX file of an expert, absolute: ``embedded`` is the one that ships, the name of an expert in the
    registry is the installed one, anything else is a path.

    Raises InputError when an expert of the registry is not installed.
    """
    if spec == EMBEDDED:
        return Path(str(files("cleargs.models"))).absolute() / "weights" / "restorer.onnx"
    return installed_file(spec, "expert") or Path(spec).absolute()


def load_expert(spec: str) -> Expert:
    """The expert named by ``spec`` (see `expert_path`). Raises InputError as `OnnxExpert` does, and where an
    installed file is not what was installed."""
    path = expert_path(spec)
    if model := installable(spec, "expert"):
        verify(model, path.parent)
    return OnnxExpert(path, name=spec if spec == EMBEDDED or model else None)
