"""ONNX models on onnxruntime's CPU provider, one thread a call: results never depend on the thread count.

Parallelism is the caller's: `OnnxModel.run` may be called from several threads at once (for instance one
image tile each), and every call computes the same bits.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cleargs.errors import InputError


@dataclass(frozen=True)
class TensorInfo:
    """Name, shape (None where free) and element type (``float``, ``float16``...) of an input or output."""

    name: str
    shape: tuple[int | None, ...]
    dtype: str


class OnnxModel:
    """An ONNX file ready to run on the CPU.

    Raises InputError when the file is missing or not an ONNX model that onnxruntime can run.
    """

    def __init__(self, path: Path) -> None:
        import onnxruntime

        if not path.is_file():
            raise InputError(f"model file {path} does not exist", hint="give the path of an .onnx file")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        options.log_severity_level = 3
        try:
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's exceptions share no base class of their own
            reason = str(error).strip().splitlines()[0]
            raise InputError(
                f"{path} is not an ONNX model that can be run: {reason}",
                hint="export the model again as a single ONNX file with standard operators",
            ) from error
        self.path = path
        self.inputs = _describe(session.get_inputs())
        self.outputs = _describe(session.get_outputs())
        self._session: Any = session

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the file in hexadecimal."""
        with self.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def run(self, *tensors: NDArray[Any]) -> list[NDArray[np.float32]]:
        """All outputs for the given inputs, in the model's order. Several threads may call this at once."""
        feeds = {info.name: tensor for info, tensor in zip(self.inputs, tensors, strict=True)}
        outputs: list[NDArray[np.float32]] = self._session.run(None, feeds)
        return outputs


def _describe(arguments: Sequence[Any]) -> tuple[TensorInfo, ...]:
    return tuple(
        TensorInfo(
            name=argument.name,
            shape=tuple(extent if isinstance(extent, int) else None for extent in argument.shape),
            dtype=argument.type.removeprefix("tensor(").removesuffix(")"),
        )
        for argument in arguments
    )
