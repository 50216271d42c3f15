"""Training state on disk: ``state.safetensors`` next to a finished scene, and checkpoints within a stage.

Everything is stored as a tensor, even the step: safetensors writes several metadata keys in no fixed order.
"""

from __future__ import annotations

import re
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from cleargs.errors import StoreError
from cleargs.files import atomic_path, disk_error
from cleargs.progress import Reporter
from cleargs.safe_io import cause
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.types import Moments


def save_state(path: Path, tensors: dict[str, Tensor]) -> None:
    """Write named tensors atomically, without a copy in memory; equal tensors give equal bytes.

    Raises StoreError if the disk is full or not writable.
    """
    with atomic_path(path) as temporary:
        temporary.touch()
        mode = temporary.stat().st_mode
        try:
            save_file(
                {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, temporary
            )
        except SafetensorError as error:  # for a full disk, too, whose number is only in the text
            number = re.search(r"os error (\d+)", str(error))
            raise disk_error(OSError(int(number[1]) if number else 0, str(error)), path) from error
        temporary.chmod(mode)  # safetensors replaces the file by one that only its owner may read


def load_state(path: Path, reporter: Reporter) -> dict[str, Tensor] | None:
    """Return the tensors in a file, or None if the file is missing or (with a warning) damaged."""
    if not path.exists():
        return None
    try:
        return load_file(path)
    except (OSError, SafetensorError, ValueError) as error:
        reporter.warn(f"ignoring the damaged checkpoint {path.name}: {error}")
        return None


def read_moments(path: Path, gaussians: Gaussians) -> Moments:
    """Read the moments of Adam from the ``state.safetensors`` of the training whose scene has ``gaussians``.

    Raises StoreError if the file is missing or damaged, or belongs to a different scene.
    """
    hint = "repeat the stage that wrote it with --force"
    try:
        moments = Moments.of_state(load_file(path))
    except (OSError, SafetensorError, ValueError) as error:
        raise StoreError(f"cannot read {path}: {cause(error)}", hint=hint) from error
    expected = {name: tensor.shape for name, tensor in gaussians.tensors().items()}
    for group in (moments.first, moments.second):
        if {name: tensor.shape for name, tensor in group.items()} != expected:
            raise StoreError(f"the moments in {path} do not fit the scene next to it", hint=hint)
    return moments
