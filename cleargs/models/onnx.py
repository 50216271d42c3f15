"""ONNX models on onnxruntime: on the CPU one thread a call, so that results never depend on the thread count.

Parallelism is over the items of `OnnxModel.map` (image tiles, say): on the CPU several threads take one item
each, and every call computes the same bits; on a GPU one call takes several items.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from io import StringIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cleargs.errors import InputError, StageError
from cleargs.plugins import installed_version
from cleargs.safe_io import cause, read_bytes

Device = Literal["cpu", "cuda"]

CUDA_PROVIDER = "CUDAExecutionProvider"

BATCH_PIXELS = 8 * 512 * 512
"""Pixels of a batch, at most."""

_EXHAUSTED = ("bad_alloc", "allocate memory", "out of memory", "alloc_failed")
"""How onnxruntime, CUDA and cuDNN say it; onnxruntime has no exception of its own for it."""

_FATAL = 4
_EXTERNAL_FOLDER = "session.model_external_initializers_file_folder_path"
"""Where onnxruntime looks for weights that a model given as bytes keeps outside."""

_CUDA_OPTIONS = {
    "use_tf32": "0",  # ten bits of mantissa would be too few to compare scores by
    "cudnn_conv_algo_search": "HEURISTIC",  # a search by time may end with another algorithm each time
    "arena_extend_strategy": "kSameAsRequested",  # the splatting shares the GPU's memory
}


RUNTIMES = ("onnxruntime", "onnxruntime-gpu", "onnxruntime-directml", "onnxruntime-openvino")
"""Distributions that bring the module onnxruntime, each with its own providers."""


def installed_runtimes() -> str:
    """The installed ones with their versions; "absent" without one."""
    versions = {name: installed_version(name) for name in RUNTIMES}
    return ", ".join(f"{name} {found}" for name, found in versions.items() if found != "absent") or "absent"


@cache
def runtime_version(device: Device) -> str:
    """The installed runtimes with the device that runs the networks. On a GPU, only a trial tells it."""
    return f"{installed_runtimes()}, on {network_device(device, lambda warning: None)}"


def network_device(device: Device, warn: Callable[[str], None]) -> Device:
    """Where onnxruntime can run the networks of work on ``device``.

    That is the GPU only where onnxruntime's CUDA provider is there and loads; where not, ``warn`` is told
    why, once, and the CPU serves.
    """
    if device == "cpu":
        return "cpu"
    import onnxruntime

    if CUDA_PROVIDER not in onnxruntime.get_available_providers():
        warn("experts and scorers run on the CPU: onnxruntime has no CUDA provider (onnxruntime-gpu has)")
        return "cpu"
    if hasattr(onnxruntime, "preload_dlls"):
        with redirect_stdout(StringIO()):
            onnxruntime.preload_dlls()  # finds the libraries of CUDA that came with PyTorch
    probe = Path(str(files("cleargs.models"))) / "weights" / "scorer.onnx"
    if OnnxModel(probe, device).device == "cpu":
        warn("experts and scorers run on the CPU: onnxruntime's CUDA provider does not load")
        return "cpu"
    return "cuda"


@dataclass(frozen=True)
class TensorInfo:
    """Name, shape (None where free) and element type (``float``, ``float16``...) of an input or output."""

    name: str
    shape: tuple[int | None, ...]
    dtype: str


class OnnxModel:
    """An ONNX file ready to run, on the CPU where the GPU's provider does not load (see `network_device`).

    The model is the file and nothing else: weights that it keeps in other files are in no digest and would
    change unseen. Raises InputError when the file is missing, refers to other files, or is not an ONNX model
    that onnxruntime can run; MemoryError when the model does not fit.
    """

    def __init__(self, path: Path, device: Device = "cpu") -> None:
        import onnxruntime

        try:
            model = read_bytes(path)
        except OSError as error:
            raise InputError(
                f"the model {path} cannot be read: {cause(error)}", hint="give the path of an .onnx file"
            ) from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        options.log_severity_level = _FATAL  # what goes wrong is raised, and told once
        options.add_session_config_entry(_EXTERNAL_FOLDER, os.devnull)  # nothing can lie in there
        session = None
        if device == "cuda":  # the provider may not load, which onnxruntime also prints on stdout
            providers = [(CUDA_PROVIDER, _CUDA_OPTIONS), "CPUExecutionProvider"]
            with suppress(Exception), redirect_stdout(StringIO()):
                session = onnxruntime.InferenceSession(model, options, providers=providers)
        try:
            if session is None:
                session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's exceptions share no base class of their own
            _raise_exhausted(path, error)
            reason = "it keeps weights in other files" if "xternal data" in str(error) else _reason(error)
            raise InputError(
                f"{path} is not an ONNX model that can be run: {reason}",
                hint="export the model again as a single ONNX file with standard operators",
            ) from error
        self.path = path
        self.digest = hashlib.sha256(model).hexdigest()
        """SHA-256 of the file in hexadecimal."""
        self.device: Device = "cuda" if CUDA_PROVIDER in session.get_providers() else "cpu"
        self.inputs = _describe(session.get_inputs())
        self.outputs = _describe(session.get_outputs())
        self._session: Any = session

    @property
    def takes_batches(self) -> bool:
        """Whether several items a call are possible, and worth it: on a GPU, where the first axis is free."""
        return self.device == "cuda" and all(info.shape[:1] == (None,) for info in self.inputs)

    def run(self, *tensors: NDArray[Any]) -> list[NDArray[np.float32]]:
        """All outputs for the given inputs, in the model's order. Several threads may call this at once.

        Raises MemoryError, and StageError for whatever else onnxruntime stops at.
        """
        feeds = {info.name: tensor for info, tensor in zip(self.inputs, tensors, strict=True)}
        try:
            outputs: list[NDArray[np.float32]] = self._session.run(None, feeds)
        except Exception as error:  # onnxruntime's exceptions share no base class of their own
            _raise_exhausted(self.path, error)
            raise StageError(
                f"the model {self.path.name} failed: {_reason(error)}",
                hint="check it with `cleargs models verify`, or choose another model",
            ) from error
        return outputs

    def map(
        self,
        function: Callable[[NDArray[np.float32]], NDArray[np.float32]],
        items: Sequence[NDArray[np.float32]],
        threads: int,
    ) -> Iterator[Any]:
        """The results of ``function`` for ``items`` [H, W, C] of one size, in their order.

        function: maps a stack [N, H, W, C] to results [N, ...] by calling `run` once.
        threads: items at once on the CPU. On a GPU a batch is as large as fits.
        """
        if self.takes_batches:
            yield from in_batches(function, items)
            return
        with ThreadPoolExecutor(1 if self.device == "cuda" else threads) as pool:
            yield from pool.map(lambda item: function(item[None])[0], items)


def in_batches(
    function: Callable[[NDArray[np.float32]], NDArray[np.float32]], items: Sequence[NDArray[np.float32]]
) -> list[Any]:
    """The results of ``function`` for ``items`` [H, W, ...] of one size, in their order.

    A batch that the GPU's memory does not hold is tried again by halves. Raises StageError when a single item
    is too large.
    """
    pixels = items[0].shape[0] * items[0].shape[1]
    size = max(1, BATCH_PIXELS // pixels)
    results: list[Any] = []
    while len(results) < len(items):
        batch = np.stack(items[len(results) : len(results) + size])
        try:
            results.extend(function(batch))
        except MemoryError as error:
            if len(batch) == 1:
                raise StageError(
                    f"the GPU's memory does not hold a network's work on {pixels} pixels",
                    hint="free memory on the GPU, or use --device cpu",
                ) from error
            size = len(batch) // 2
    return results


def _raise_exhausted(path: Path, error: Exception) -> None:
    """Raise MemoryError if that is what onnxruntime reports."""
    if any(words in str(error).lower() for words in _EXHAUSTED):
        raise MemoryError(f"{path.name}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return (str(error).strip() or "no reason was given").splitlines()[0]


def _describe(arguments: Sequence[Any]) -> tuple[TensorInfo, ...]:
    return tuple(
        TensorInfo(
            name=argument.name,
            shape=tuple(extent if isinstance(extent, int) else None for extent in argument.shape),
            dtype=argument.type.removeprefix("tensor(").removesuffix(")"),
        )
        for argument in arguments
    )
