"""What the conversions share: their environment, and the export of torch modules to ONNX."""

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
    """Raise InputError if one of the packages cannot be imported here."""
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise InputError(
            f"{purpose} needs {' and '.join(missing)}, which this environment lacks",
            hint="run `make convert-env` once, then the same command with .venv-convert/bin/python",
        )


def first_line(error: Exception) -> str:
    """What an error of another package says, in one line."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def mend_torchvision() -> None:
    """Let torchvision be imported beside a CPU build of torch.

    Its released build registers shapes for two detection operators that its library, which does not load
    there, would define. Declared here, they can be imported; nothing converted calls them.
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

    free: for each input, which of its axes may have any extent, as ``torch.export`` names them.
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
