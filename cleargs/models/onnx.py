"""ONNX models on onnxruntime. CPU calls use one thread, so results do not depend on the thread count.

`OnnxModel.map` is parallel over its items, for example image tiles. On the CPU several threads process one
item each. On a GPU one call processes several items.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout, suppress
from functools import cache
from importlib.resources import files
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from cleargs.errors import InputError, StageError
from cleargs.plugins import installed_version
from cleargs.safe_io import faults_as, read_bytes
from cleargs.types import AnyArray, ArrayF32, Device

os.environ.setdefault(
    "ORT_DISABLE_TELEMETRY", "1"
)  # else onnxruntime 1.29 and later sends facts about its use

CUDA_PROVIDER = "CUDAExecutionProvider"

BATCH_PIXELS = 8 * 512 * 512
"""Maximum number of pixels in a batch."""

_MEMORY_ERRORS = ("bad_alloc", "allocate memory", "out of memory", "alloc_failed")
"""Texts of onnxruntime, CUDA and cuDNN for exhausted memory; onnxruntime has no exception class for it."""

_FATAL = 4
_EXTERNAL_FOLDER = "session.model_external_initializers_file_folder_path"
"""Option for the folder of external weights, for a model that is given as bytes."""

_CUDA_OPTIONS = {
    "use_tf32": "0",  # its mantissa of 10 bits is too short to compare scores
    "cudnn_conv_algo_search": "HEURISTIC",  # a search by time may select a different algorithm in each run
    "arena_extend_strategy": "kSameAsRequested",  # the splatting kernels share the GPU's memory
}


RUNTIMES = ("onnxruntime", "onnxruntime-gpu", "onnxruntime-directml", "onnxruntime-openvino")
"""Distributions that provide the module onnxruntime, with different providers."""


def installed_runtimes() -> str:
    """Return the installed distributions of `RUNTIMES` with their versions, or "absent"."""
    versions = {name: installed_version(name) for name in RUNTIMES}
    return ", ".join(f"{name} {found}" for name, found in versions.items() if found != "absent") or "absent"


@cache
def runtime_version(device: Device) -> str:
    """Return the installed runtimes with the device that runs the networks (see `network_device`)."""
    return f"{installed_runtimes()}, on {network_device(device, lambda warning: None)}"


def network_device(device: Device, warn: Callable[[str], None]) -> Device:
    """Return ``cuda`` if a run on ``device`` can run networks there, which a trial determines, else ``cpu``.

    ``warn`` receives a warning if the run uses a GPU but onnxruntime cannot.
    """
    if device == "cpu":
        return "cpu"
    import onnxruntime

    if CUDA_PROVIDER not in onnxruntime.get_available_providers():
        warn("experts and scorers run on the CPU: onnxruntime has no CUDA provider (onnxruntime-gpu has one)")
        return "cpu"
    if hasattr(onnxruntime, "preload_dlls"):
        with redirect_stdout(StringIO()):
            onnxruntime.preload_dlls()  # finds the CUDA libraries that PyTorch includes
    probe = Path(str(files("cleargs.models"))) / "weights" / "scorer.onnx"
    if OnnxModel(probe, device).device == "cpu":
        warn("experts and scorers run on the CPU: onnxruntime's CUDA provider does not load")
        return "cpu"
    return "cuda"


class OnnxModel:
    """An ONNX file, loaded by onnxruntime. It runs on the CPU if the GPU's provider does not load.

    The file must contain all weights, because the digest does not cover other files. ``device`` is a result
    of `network_device`. Raises InputError if the file is missing, refers to other files, or is not a model
    that onnxruntime can run, and MemoryError if the model does not fit into memory.
    """

    def __init__(self, path: Path, device: Device = "cpu") -> None:
        import onnxruntime

        with faults_as(InputError, f"the model {path} cannot be read", hint="give the path of an .onnx file"):
            model = read_bytes(path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        options.log_severity_level = _FATAL  # errors are raised, so they need no log
        options.add_session_config_entry(_EXTERNAL_FOLDER, os.devnull)  # no folder, so no external weights
        session = None
        if device == "cuda":  # the provider may not load, and onnxruntime prints that to stdout
            providers = [(CUDA_PROVIDER, _CUDA_OPTIONS), "CPUExecutionProvider"]
            with suppress(Exception), redirect_stdout(StringIO()):
                session = onnxruntime.InferenceSession(model, options, providers=providers)
        try:
            if session is None:
                session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's exceptions have no common base class
            _raise_exhausted(path, error)
            reason = "it stores weights in other files" if "xternal data" in str(error) else _reason(error)
            raise InputError(
                f"{path} is not an ONNX model that can be run: {reason}",
                hint="export the model again as a single ONNX file with standard operators",
            ) from error
        self.path = path
        self.digest = hashlib.sha256(model).hexdigest()
        """SHA-256 of the file, hexadecimal."""
        self.device: Device = "cuda" if CUDA_PROVIDER in session.get_providers() else "cpu"
        self._session: Any = session
        self._inputs = session.get_inputs()
        self.inputs, self.outputs = (
            [tuple(side if isinstance(side, int) else None for side in argument.shape) for argument in those]
            for those in (self._inputs, session.get_outputs())
        )
        """Shapes; None: free."""
        self.takes_floats = all(argument.type == "tensor(float)" for argument in self._inputs)

    @property
    def takes_batches(self) -> bool:
        """True if `map` runs several items per call: on a GPU, if the first axis of all inputs is free."""
        return self.device == "cuda" and all(shape[:1] == (None,) for shape in self.inputs)

    def run(self, *tensors: AnyArray) -> list[ArrayF32]:
        """Return all outputs for the given inputs, both in the model's order. The method is thread-safe.

        Raises MemoryError if the memory is too small, and StageError if onnxruntime fails otherwise.
        """
        feeds = {info.name: tensor for info, tensor in zip(self._inputs, tensors, strict=True)}
        try:
            outputs: list[ArrayF32] = self._session.run(None, feeds)
        except Exception as error:  # onnxruntime's exceptions have no common base class
            _raise_exhausted(self.path, error)
            raise StageError(
                f"the model {self.path.name} failed: {_reason(error)}",
                hint="check it with `cleargs models verify`, or choose another model",
            ) from error
        return outputs

    def map(
        self, function: Callable[[ArrayF32], ArrayF32], items: Sequence[ArrayF32], threads: int
    ) -> Iterator[Any]:
        """Apply ``function`` to all items [H, W, C] of one size, and yield the results in their order.

        ``function`` maps a batch [N, H, W, C] to results [N, ...] with one call of `run`. On the CPU
        ``threads`` items are processed at the same time, on a GPU as many as fit.
        """
        if self.takes_batches:
            yield from in_batches(function, items)
            return
        with ThreadPoolExecutor(1 if self.device == "cuda" else threads) as pool:
            yield from pool.map(lambda item: function(item[None])[0], items)


def in_batches(
    function: Callable[[ArrayF32], ArrayF32], items: Sequence[ArrayF32], max_pixels: int = BATCH_PIXELS
) -> list[Any]:
    """Return the results of ``function`` for ``items`` [H, W, ...] of one size, computed in batches.

    A batch has at most ``max_pixels``, or one item. Its size is halved if a batch does not fit into the GPU's
    memory. StageError is raised if one item does not.
    """
    pixels = items[0].shape[0] * items[0].shape[1]
    size = max(1, max_pixels // pixels)
    results: list[Any] = []
    while len(results) < len(items):
        batch = np.stack(items[len(results) : len(results) + size])
        try:
            results.extend(function(batch))
        except MemoryError as error:
            if len(batch) == 1:
                raise StageError(
                    f"the GPU's memory does not hold the data of a network for {pixels} pixels",
                    hint="free memory on the GPU, or use --device cpu",
                ) from error
            size = len(batch) // 2
    return results


def _raise_exhausted(path: Path, error: Exception) -> None:
    if any(words in str(error).lower() for words in _MEMORY_ERRORS):
        raise MemoryError(f"{path.name}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return (str(error).strip() or "no reason was given").splitlines()[0]
