"""Which frames are held out for testing."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.sharpest import sharpness
from cleargs.errors import InputError


def held_out(
    rule: str, names: Sequence[str], read: Callable[[int], NDArray[np.uint8]], registered: Sequence[bool]
) -> set[int]:
    """Indices of the test frames by ``ingest.holdout``; ``read`` gives frame i as RGB (for sharpest:N only).

    every:N holds out frames 0, N, 2N, ... (as Mip-NeRF 360 and 3DGS do with N = 8); sharpest:N the sharpest
    of every N registered frames in a row, also of the shorter rest (3dgs-deblur's
    ``train_eval_split_by_blur_score.py`` with N = 8, which has its blur scores from the recording), so that
    tests are both clean and spread over the capture; ties go to the earlier frame.
    Raises InputError for unknown names, and when no registered frame is left for training.
    """
    kind, _, number = rule.partition(":")
    if rule == "none":
        return set()
    if kind == "every":
        chosen = set(range(0, len(names), int(number)))
    elif kind == "sharpest":
        period = int(number)
        candidates = [index for index in range(len(names)) if registered[index]]
        stretches = [candidates[start : start + period] for start in range(0, len(candidates), period)]
        chosen = {max(stretch, key=lambda index: sharpness(read(index))) for stretch in stretches}
    else:
        items = [item.strip() for item in rule.split(",") if item.strip()]
        chosen = {index for item in items for index in _matching(item, names)}
    if not any(flag and index not in chosen for index, flag in enumerate(registered)):
        raise InputError(f"ingest.holdout={rule} leaves no frame to train on", hint="hold out fewer frames")
    return chosen


def holdout_hash(rule: str, names: Iterable[str]) -> str:
    """SHA-256 over the rule and the sorted names of the test frames: equal for equal splits by one rule."""
    return hashlib.sha256(json.dumps([rule, sorted(names)]).encode()).hexdigest()


def _matching(item: str, names: Sequence[str]) -> list[int]:
    """Frames of which path, file name or stem is ``item`` or fits it as a pattern (``*``, ``?``, ``[]``)."""
    found = []
    for index, name in enumerate(names):
        spellings = (name, Path(name).name, Path(name).stem)
        if item in spellings or any(fnmatchcase(spelling, item) for spelling in spellings):
            found.append(index)
    if not found:
        raise InputError(
            f"ingest.holdout names the frame {item}, which is not among the chosen frames",
            hint="use names or stems of frames of the capture (cleargs show RUN ingest lists them)",
        )
    return found
