"""Shared parts of the conversions: the check of the environment and the export to ONNX."""

from __future__ import annotations

import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from cleargs.errors import InputError

_OPSET = 18


def require(*packages: str, purpose: str) -> None:
    """Raise InputError if a package is not installed; ``purpose`` begins the message."""
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise InputError(
            f"{purpose} needs {' and '.join(missing)}, which this environment lacks",
            hint="run `make convert-env` once, then the same command with .venv-convert/bin/python",
        )


def first_line(error: Exception) -> str:
    """Return the first line of an error's message, or the name of its type."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def declare_torchvision_operators() -> None:
    """Declare two operators that torchvision needs for its import with a CPU build of torch.

    torchvision registers shapes for two detection operators. Its compiled library, which defines them, does
    not load with such a torch. No converted network calls them.
    """
    for name in ("nms", "qnms"):
        if not hasattr(torch.ops.torchvision, name):
            torch.library.define(
                f"torchvision::{name}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"
            )


def export(
    network: nn.Module,
    example: tuple[Tensor, ...],
    path: Path,
    *,
    inputs: tuple[str, ...],
    output: str,
    free: tuple[dict[int, Any], ...] | None = None,
) -> None:
    """Write a network in evaluation mode as one ONNX file.

    Args:
        network: The network.
        example: Example inputs.
        path: File to write.
        inputs: Names of the inputs.
        output: Name of the output.
        free: Axes of variable size for each input, in the form of ``torch.export``.
    """
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            example,
            path,
            input_names=list(inputs),
            output_names=[output],
            opset_version=_OPSET,
            dynamo=True,
            dynamic_shapes=free,
            external_data=False,
            verbose=False,
        )
