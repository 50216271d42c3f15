"""Which frames are held out for testing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.errors import InputError


def held_out(
    rule: str, names: Sequence[str], read: Callable[[int], NDArray[np.uint8]], registered: Sequence[bool]
) -> set[int]:
    """Indices of the test frames by ``ingest.holdout``; ``read`` gives frame i as RGB (for sharpest:N only).

    every:N holds out frames 0, N, 2N, ... (as Mip-NeRF 360 and 3DGS do with N = 8); sharpest:N the sharpest
    registered frame of each of N equal stretches, so that tests are both clean and spread over the capture.
    Raises InputError for unknown names, and when no registered frame is left for training.
    """
    kind, _, number = rule.partition(":")
    if rule == "none":
        return set()
    if kind == "every":
        chosen = set(range(0, len(names), int(number)))
    elif kind == "sharpest":
        candidates = [index for index in range(len(names)) if registered[index]]
        stretches = np.array_split(np.array(candidates), min(int(number), len(candidates)))
        chosen = {max(stretch.tolist(), key=lambda index: sharpness(read(index))) for stretch in stretches}
    else:
        chosen = {_find(item.strip(), names) for item in rule.split(",") if item.strip()}
    if not any(flag and index not in chosen for index, flag in enumerate(registered)):
        raise InputError(f"ingest.holdout={rule} leaves no frame to train on", hint="hold out fewer frames")
    return chosen


def sharpness(rgb: NDArray[np.uint8]) -> float:  # [H, W, 3]
    """Variance of the Laplacian of the grey image; sums of whole numbers, so exact."""
    laplacian = np.asarray(cv2.Laplacian(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), cv2.CV_16S)).astype(np.int64)
    count = laplacian.size
    return float(count * int((laplacian**2).sum()) - int(laplacian.sum()) ** 2) / count**2


def _find(item: str, names: Sequence[str]) -> int:
    for index, name in enumerate(names):
        if item in (name, Path(name).name, Path(name).stem):
            return index
    raise InputError(
        f"ingest.holdout names the frame {item}, which is not among the chosen frames",
        hint="use names or stems of frames of the capture (cleargs show RUN ingest lists them)",
    )
