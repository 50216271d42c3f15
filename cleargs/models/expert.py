"""The frozen restoration expert of RIVR: an image in, a sharper image of the same size out.

Any ONNX restoration network serves: NCHW or NHWC, fixed or free size. The embedded default is the network of
`tools/train_models/train_restorer.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Protocol

import numpy as np

from cleargs.errors import InputError, StageError, did_you_mean
from cleargs.models.batches import in_batches
from cleargs.models.onnx import Device, OnnxModel
from cleargs.models.registry import installable, installed_file, load_registry, verify
from cleargs.models.tiling import Image, apply_tiled, map_tiled
from cleargs.plugins import load_part, plugins

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
        self._batches = model.takes_batches
        self._calls = 1 if model.device == "cuda" else None  # at once; None: as many as threads
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
        if self._batches:
            restored = map_tiled(self._restore_in_batches, image, fixed=self._fixed, on_tile=on_tile)
        else:
            calls = self._calls or threads
            restored = apply_tiled(
                self._restore_tile, image, fixed=self._fixed, threads=calls, on_tile=on_tile
            )
        if not np.isfinite(restored).all():
            raise StageError(
                f"the restoration expert {self.name} returned values that are not finite",
                hint="check the model file, or set rivr.expert to another one",
            )
        return np.clip(restored, np.float32(0.0), np.float32(1.0))

    def _restore_tile(self, tile: Image) -> Image:
        restored: Image = self._restore_batch(tile[None])[0]
        return restored

    def _restore_in_batches(self, tiles: Sequence[Image]) -> Sequence[Image]:
        height, width = tiles[0].shape[:2]
        return in_batches(self._restore_batch, tiles, height * width)

    def _restore_batch(self, tiles: Image) -> Image:
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


def expert_path(spec: str) -> Path | None:
    """The ONNX file of an expert, absolute: ``embedded`` is the one that ships, the name of an expert in the
    registry is the installed one, a name with an ending or a folder is a path. None for an expert that
    another package brings: its version stands in the key of the store instead.

    Raises InputError for any other name, and when an expert of the registry is not installed.
    """
    if spec == EMBEDDED:
        return Path(str(files("cleargs.models"))).absolute() / "weights" / "restorer.onnx"
    path = installed_file(spec, "expert") or Path(spec).absolute()
    if path.name == spec and not (path.suffix or path.exists()):
        brought = plugins("experts")
        if spec in brought:
            return None
        names = [EMBEDDED, *(model.name for model in load_registry() if model.role == "expert"), *brought]
        raise InputError(
            f"there is no restoration expert {spec!r}",
            hint=did_you_mean(spec, names, f"choose {', '.join(names)}, or give an ONNX file"),
        )
    return path


def load_expert(spec: str, device: Device = "cpu") -> Expert:
    """The expert named by ``spec`` (see `expert_path`), on what `network_device` found. Raises InputError as
    `OnnxExpert` does, and where an installed file is not what was installed."""
    path = expert_path(spec)
    if path is None:
        maker: Callable[[Device], Expert] = load_part("experts", spec)
        return maker(device)
    if model := installable(spec, "expert"):
        verify(model, path.parent)
    return OnnxExpert(path, name=spec if spec == EMBEDDED or model else None, device=device)
