"""Convert restoration networks from their authors' checkpoints, with spandrel: Restormer, NAFNet and others.

spandrel recognises the architecture by the names and shapes of the weights. The checkpoint is read as tensors
only, so it cannot run code.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path

import torch
from torch import Tensor, nn

from cleargs.errors import InputError
from tools.convert_models.torch_export import declare_torchvision_operators, export, first_line


def convert(checkpoint: bytes, path: Path, tile: int = 256) -> None:
    """Write the network of a checkpoint as ONNX, for tiles of one size.

    Input ``image`` and output ``restored`` are [1, 3, tile, tile] float32 sRGB in [0, 1].

    Args:
        checkpoint: Content of the file.
        path: ONNX file to write.
        tile: Tile size, px.

    Raises:
        InputError: spandrel does not know the architecture, or it does not restore colour images.
    """
    network = load(checkpoint)
    example = torch.linspace(0.0, 1.0, 3 * tile * tile).reshape(1, 3, tile, tile)
    export(network, (example,), path, inputs=("image",), output="restored")


def load(checkpoint: bytes) -> nn.Module:
    """Return the network of a checkpoint in evaluation mode; raise InputError like `convert`."""
    declare_torchvision_operators()
    import spandrel
    import spandrel_extra_arches

    spandrel_extra_arches.install(ignore_duplicates=True)
    try:
        state = torch.load(io.BytesIO(checkpoint), map_location="cpu", weights_only=True)
        descriptor = spandrel.ModelLoader().load_from_state_dict(spandrel.canonicalize_state_dict(state))
    except (spandrel.UnsupportedModelError, pickle.UnpicklingError, RuntimeError, EOFError) as error:
        raise InputError(
            f"this is not a checkpoint of a known architecture: {first_line(error)}",
            hint="give the unchanged file from its authors (.pth)",
        ) from error
    if not isinstance(descriptor, spandrel.ImageModelDescriptor) or (
        descriptor.scale,
        descriptor.input_channels,
        descriptor.output_channels,
    ) != (1, 3, 3):
        raise InputError(
            f"this {descriptor.architecture.name} network does not restore colour images at their size",
            hint="give a checkpoint for deblurring or denoising colour images",
        )
    return _OneImage(descriptor.model.eval().requires_grad_(False))


class _OneImage(nn.Module):
    """A wrapper of a network with a single input and output."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        restored: Tensor = self.network(image)
        return restored
