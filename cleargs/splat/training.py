"""The loop of a training: its steps, checkpoints and preview, and the progress bar."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
from torch import Tensor

from cleargs.media.image import write_rgb
from cleargs.memory import release_freed
from cleargs.progress import PREVIEW, Reporter, Task
from cleargs.splat import compilation
from cleargs.splat.backend import backend_for
from cleargs.splat.interruption import deferred_sigterm
from cleargs.splat.kernels.cuda import support
from cleargs.splat.scene import Scene
from cleargs.splat.state import load_state, save_state
from cleargs.splat.trainer import NOTE_INTERVAL, Trainer
from cleargs.timing import timed

_CHECK_INTERVAL = 10
"""Steps between checks for NaN and infinity (a check takes less than 1 ms for 50,000 Gaussians)."""

_RELEASE_INTERVAL = 50
"""Steps of the CPU between releases of freed memory: 7 % less at the peak for about 1 % of the time."""

_SHORT_SAVE, _SAVE_SHARE = 0.1, 0.05
"""Checkpoints of up to `_SHORT_SAVE` s are saved whenever they are due. Longer ones take up to this share of
the time. On an H200, 200 steps with up to 400,000 Gaussians take about 3 s, and their checkpoint 0.4 s."""


@dataclass(frozen=True)
class Trained:
    """Result of a training."""

    scene: Scene
    rows: pa.Table
    """Log with one row per step, schema `cleargs.splat.tables.TRAIN`."""
    state: dict[str, Tensor]
    """Content of ``state.safetensors``, from which the next training continues: all but the parameters."""


def run(
    trainer: Trainer, *, checkpoint: Path, reporter: Reporter, label: str = "training", round: int = 0
) -> Trained:
    """Train to the end, and return the result. ``label`` is the name of the training in messages.

    If the file ``checkpoint`` belongs to this training, the training resumes from it; the result is the
    same bit for bit. A preview is written next to it. After a SIGTERM, if the program has a handler for
    it, the training saves a checkpoint and stops. ``round`` is a column of the log.

    Raises:
        StageError: A parameter or the loss is not finite.
        KeyboardInterrupt: The process received SIGTERM.
    """
    saved = load_state(checkpoint, reporter)
    if saved is not None and not trainer.matches(saved):
        reporter.warn(f"ignoring {checkpoint.name}: it belongs to another training")
    elif saved is not None:
        trainer.restore(saved)
        reporter.info(f"{label}: resuming from step {trainer.done} of {trainer.length}")
    device = trainer.scene.gaussians.device
    release_freed()
    compilation.finish(device.type, backend_for(device).warm_up, reporter)
    with (
        support.memory_errors(),
        deferred_sigterm() as terminated,
        reporter.task(label, total=trainer.length) as task,
    ):
        fractions = trainer.work_fractions()
        next_save = 0.0
        while trainer.done < trainer.length:
            trainer.step()
            stopped, now = terminated(), time.monotonic()
            due = stopped or (
                trainer.done % trainer.checkpoint_interval == 0
                and trainer.done < trainer.length
                and now >= next_save
            )
            if trainer.done % NOTE_INTERVAL == 0:
                _show(trainer, task, fractions)
            if device.type == "cpu" and trainer.done % _RELEASE_INTERVAL == 0:
                release_freed()
            if due or trainer.done % _CHECK_INTERVAL == 0:
                trainer.check_finite()
            if due:
                with timed("checkpoint and preview"):
                    save_state(checkpoint, trainer.state())
                    write_rgb(checkpoint.with_name(PREVIEW), trainer.preview().cpu().numpy())
                next_save = _next_save(now, time.monotonic())
            if stopped:
                raise KeyboardInterrupt
        trainer.check_finite()
        _show(trainer, task, fractions)
    state = {k: tensor.cpu() for k, tensor in trainer.state().items() if not k.startswith("parameter.")}
    return Trained(trainer.scene.to("cpu"), trainer.rows(round), state)


def _show(trainer: Trainer, task: Task, fractions: Sequence[float]) -> None:
    """Show PSNR and number of Gaussians next to the steps done.

    Steps per second would not agree with the time left: later steps have more Gaussians, and take longer.
    """
    note = f"training PSNR {trainer.last_psnr:.2f} dB, {trainer.scene.gaussians.num} Gaussians"
    task.update(done=trainer.done, note=note, share=fractions[trainer.done])


def _next_save(begun: float, ended: float) -> float:
    """Return the time of the earliest next checkpoint after one that took from ``begun`` to ``ended``, s."""
    seconds = ended - begun
    return ended if seconds <= _SHORT_SAVE else ended + seconds * (1.0 / _SAVE_SHARE - 1.0)
