"""Exporting torch modules to ONNX."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

_OPSET = 18


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
