"""Log of a training, one row per step."""

from __future__ import annotations

import math

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from cleargs.splat.tables import TRAIN
from cleargs.splat.types import Reading
from cleargs.splat.views import TrainingView

_ROW = np.dtype(
    [
        (field.name, np.bool_ if field.name == "kind" else field.type.to_pandas_dtype())
        for field in TRAIN
        if field.name not in ("round", "step")
    ]
)
"""Type of a row in memory; ``kind`` is True for a pseudo view."""

_RECENT = 50  # number of steps in the running mean of the PSNR


class TrainLog:
    """Views and losses of ``steps`` steps. Steps count from 0 in the methods, and from 1 in the table."""

    def __init__(self, steps: int) -> None:
        self._rows = np.zeros(steps, _ROW)

    def add_view(
        self, step: int, view: TrainingView, weight: float, target: Tensor, n_gaussians: int, sh_degree: int
    ) -> None:
        """Write the view of a step. `add_losses` adds the other columns."""
        self._rows[step] = (
            view.frame_id,
            view.kind == "pseudo",
            weight,
            target.shape[1],
            target.shape[0],
            *(math.nan,) * 4,
            n_gaussians,
            sh_degree,
        )

    def add_losses(self, step: int, reading: Reading) -> None:
        """Write the losses of a step. A GPU reports them some steps later."""
        self._rows[["loss", "l1", "ssim", "psnr"]][step] = reading

    def recent_psnr(self, done: int) -> float:
        """Return the mean PSNR in dB of the last 50 steps before step ``done`` (NaN if there are none).

        Steps on fully masked frames, whose PSNR is infinite, are left out.
        """
        recent = self._rows["psnr"][max(0, done - _RECENT) : done]
        recent = recent[np.isfinite(recent)]
        return float(recent.mean()) if len(recent) else math.nan

    def packed(self, done: int) -> Tensor:
        """Return the first ``done`` rows as bytes, for a checkpoint."""
        return torch.from_numpy(self._rows[:done].view(np.uint8).copy())

    def restore(self, packed: Tensor) -> None:
        """Continue from the result of `packed`."""
        rows = packed.numpy().view(_ROW)
        self._rows[: len(rows)] = rows

    def table(self, done: int, round: int) -> pa.Table:
        """Return the first ``done`` rows with the schema `cleargs.splat.tables.TRAIN`."""
        rows = self._rows[:done]
        columns = {name: rows[name] for name in _ROW.names or ()}
        columns |= {
            "round": np.full(done, round),
            "step": np.arange(1, done + 1),
            "kind": np.where(rows["kind"], "pseudo", "real"),
        }
        return pa.table({name: pa.array(columns[name]) for name in TRAIN.names}).cast(TRAIN)
