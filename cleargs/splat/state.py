"""Training state on disk: ``state.safetensors`` beside a finished scene, and checkpoints inside a stage.

Everything is a tensor, the step included: metadata of several keys would be written in no fixed order.
"""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from cleargs.errors import StoreError
from cleargs.files import write_bytes
from cleargs.progress import Reporter
from cleargs.safe_io import cause
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.types import Moments


def save_state(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write named tensors atomically; equal tensors give equal bytes."""
    write_bytes(path, save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}))


def load_state(path: Path, reporter: Reporter) -> dict[str, Tensor] | None:
    """The tensors at ``path``; None where there is no file, and (with a warning) where it is damaged."""
    if not path.exists():
        return None
    try:
        return load_file(path)
    except (OSError, SafetensorError, ValueError) as error:
        reporter.warn(f"ignoring the damaged checkpoint {path.name}: {error}")
        return None


def read_moments(path: Path, gaussians: Gaussians) -> Moments:
    """Adam's moments of a finished training, from its state; they belong to ``gaussians``, its scene.

    Raises StoreError when the file is missing or damaged, or is of other Gaussians.
    """
    hint = "run the stage that made it again with --force"
    try:
        moments = Moments.of_state(load_file(path))
    except (OSError, SafetensorError, ValueError) as error:
        raise StoreError(f"cannot read {path}: {cause(error)}", hint=hint) from error
    expected = {name: tensor.shape for name, tensor in gaussians.tensors().items()}
    for group in (moments.first, moments.second):
        if {name: tensor.shape for name, tensor in group.items()} != expected:
            raise StoreError(f"the moments in {path} are not of the scene beside it", hint=hint)
    return moments
