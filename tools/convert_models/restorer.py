"""Restoration networks from their authors' checkpoints, read by spandrel: Restormer, NAFNet and many more.

spandrel tells the architecture by the names and shapes of the weights; the checkpoint is read as tensors only
and can run no code.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path

import torch
from torch import Tensor, nn

from cleargs.errors import InputError
from tools.convert_models.torch_export import export, first_line, mend_torchvision


def convert(checkpoint: bytes, path: Path, tile: int = 256) -> None:
    """Write the network of a checkpoint as ONNX, for tiles of one size.

    Input ``image`` and output ``restored`` are [1, 3, tile, tile] float32 sRGB in [0, 1].
    Raises InputError if spandrel does not know the architecture or it is no restorer of colour images.
    """
    network = load(checkpoint)
    example = torch.linspace(0.0, 1.0, 3 * tile * tile).reshape(1, 3, tile, tile)
    export(network, (example,), path, inputs=("image",), output="restored")


def load(checkpoint: bytes) -> nn.Module:
    """The network of a checkpoint, ready for evaluation. Raises as `convert`."""
    mend_torchvision()
    import spandrel
    import spandrel_extra_arches

    spandrel_extra_arches.install(ignore_duplicates=True)
    try:
        state = torch.load(io.BytesIO(checkpoint), map_location="cpu", weights_only=True)
        descriptor = spandrel.ModelLoader().load_from_state_dict(spandrel.canonicalize_state_dict(state))
    except (spandrel.UnsupportedModelError, pickle.UnpicklingError, RuntimeError, EOFError) as error:
        raise InputError(
            f"this is no checkpoint of a known architecture: {first_line(error)}",
            hint="give the checkpoint as its authors publish it (.pth)",
        ) from error
    if not isinstance(descriptor, spandrel.ImageModelDescriptor) or (
        descriptor.scale,
        descriptor.input_channels,
        descriptor.output_channels,
    ) != (1, 3, 3):
        raise InputError(
            f"this {descriptor.architecture.name} network does not restore a colour image at its own size",
            hint="give a checkpoint for deblurring or denoising colour images",
        )
    return _Clean(descriptor.model.eval().requires_grad_(False))


class _Clean(nn.Module):
    """The network with one image in and one out."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        restored: Tensor = self.network(image)
        return restored
