"""Optimise a scene against weighted views: the one loop that G0, RIVR and the consolidation share.

No torch autograd: render -> loss and its gradient -> backward pass -> Adam -> densification. All
randomness is drawn afresh from (seed, stream, step), so that a resumed training is the same training.
"""

from __future__ import annotations

import hashlib
import json
import math
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from cleargs.errors import InputError, StageError
from cleargs.progress import PREVIEW, Rate, Reporter, Task
from cleargs.random_streams import Stream
from cleargs.splat.backend import LossAccumulator, backend_for, step_gaussians
from cleargs.splat.budget import resolve_config, seconds_by_step
from cleargs.splat.camera import Camera
from cleargs.splat.config import TrainConfig
from cleargs.splat.formation import Formation, Formed
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cuda import support
from cleargs.splat.scene import Scene
from cleargs.splat.schedule import Schedule
from cleargs.splat.state import load_state, save_state
from cleargs.splat.train_log import PREVIEW_SIDE, TrainLog, write_preview
from cleargs.splat.types import Moments, Render, group
from cleargs.splat.views import ImageCache, TrainingView, require_views

_NOTE_INTERVAL = 10
"""Steps between updates of the progress bar, and of the log where the losses lie on a GPU."""

_CHECK_INTERVAL = 10
"""Steps between looks for NaN and infinity (under 1 ms for 50,000 Gaussians)."""


@dataclass(frozen=True)
class Trained:
    """What a training leaves."""

    scene: Scene
    rows: pa.Table
    """One row a step, schema `cleargs.splat.tables.TRAIN`."""
    state: dict[str, Tensor]
    """All that a continuation needs, for ``state.safetensors``."""


class Trainer:
    """A training of ``scene`` on ``views`` for as many steps as ``config`` says: `run` does all of them.

    ``seed`` is the only source of randomness. ``formation`` None compares the views with the render as it is;
    otherwise with what the formation makes of it, which keeps learning in place. ``moments`` are Adam's, from
    the part of the schedule before this one; None: fresh ones. A share ``pseudo_share`` of the steps draws a
    pseudo view, whose loss is multiplied by ``pseudo_weight``.

    Raises InputError when no view has a weight or the scene is not finite.
    """

    def __init__(
        self,
        scene: Scene,
        views: Sequence[TrainingView],
        config: TrainConfig,
        *,
        seed: Sequence[int],
        formation: Formation | None = None,
        moments: Moments | None = None,
        pseudo_share: float = 0.0,
        pseudo_weight: float = 1.0,
        device: str = "cpu",
    ) -> None:
        weighted = [view for view in views if view.weight > 0.0]
        self._real = [view for view in weighted if view.kind == "real"]
        self._pseudo = [view for view in weighted if view.kind == "pseudo"]
        require_views(weighted)
        self._share = pseudo_share if self._real and self._pseudo else float(bool(self._pseudo))
        self._pseudo_weight = pseudo_weight
        self._config = config = resolve_config(config, self._real or self._pseudo)
        self.length = config.length
        self._seed = tuple(seed)
        self._scene = scene
        self._device = torch.device(device)
        self._backend = backend_for(self._device)
        self._rasteriser = self._backend.rasteriser(self._device)
        self._gaussians = scene.gaussians.detach().clone().to(self._device)
        if fault := _fault(self._gaussians):
            raise InputError(
                f"the scene to start from is damaged: {fault}",
                hint="run the stage that made it again with --force",
            )
        self._moments = Moments.zeros(self._gaussians) if moments is None else moments.to(self._device)
        self._before = 0 if moments is None else config.first
        self._schedule = Schedule(config, self._gaussians.sh.shape[1], self._device)
        self._errors: Tensor | None = None  # [N] since the last refinement
        self._formation = formation
        self._cache = ImageCache(config.cache_mb * 2**20, self._device, training=True)
        self._losses = LossAccumulator(self._device, config.ssim_lambda)
        self._log = TrainLog(self.length)
        self._slopes: dict[tuple[int, int], Tensor] = {}
        starts: list[float | str] = [
            *self._seed,
            self._before,
            self._share,
            pseudo_weight,
            "" if formation is None else formation.digest(),
        ]
        self._fingerprint = _fingerprint(scene, weighted, config, starts)
        self.done = 0

    def run(
        self, *, checkpoint: Path, reporter: Reporter, label: str = "training", round: int = 0
    ) -> Trained:
        """Train to the end. Resumes from ``checkpoint`` where there is one, to the same result bit for bit.
        Beside each checkpoint lies a preview.

        Raises StageError when a parameter or the loss ceases to be finite, KeyboardInterrupt behind a
        checkpoint after a SIGTERM that the program answers.
        """
        saved = load_state(checkpoint, reporter)
        if saved is not None and not self.wrote(saved):
            reporter.warn(f"ignoring {checkpoint.name}: it belongs to another training")
        elif saved is not None:
            self.restore(saved)
            reporter.info(f"{label}: resuming from step {self.done} of {self.length}")
        self._backend.warm_up()  # before the bar, or half a minute of compiling would count as pace
        with (
            support.memory_errors(),
            deferred_sigterm() as terminated,
            reporter.task(label, total=self.length) as task,
        ):
            shares, rate = self.shares_of_work(), Rate()
            while self.done < self.length:
                self.step()
                stopped = terminated()
                due = stopped or (
                    self.done % self._config.checkpoint_interval == 0 and self.done < self.length
                )
                if self.done % _NOTE_INTERVAL == 0:
                    self._show(task, shares, rate)
                if due or self.done % _CHECK_INTERVAL == 0:
                    self.check_finite()
                if due:
                    save_state(checkpoint, self.state())
                    write_preview(checkpoint.with_name(PREVIEW), self.preview())
                if stopped:
                    raise KeyboardInterrupt
            self.check_finite()
            self._show(task, shares, rate)
        state = {name: tensor.cpu() for name, tensor in self.state().items()}
        return Trained(self.scene.to("cpu"), self.rows(round), state)

    @property
    def scene(self) -> Scene:
        """The scene as trained so far (shares memory with the trainer)."""
        return replace(self._scene, gaussians=self._gaussians)

    @property
    def _at(self) -> int:
        """How many steps of the schedule lie behind."""
        return self._config.first + self.done

    @property
    def last_psnr(self) -> float:
        """Mean PSNR over the last 50 steps, dB."""
        self._read_losses()
        return self._log.recent_psnr(self.done)

    def step(self) -> None:
        """One iteration: one view, one Adam step, and what densification is due."""
        config, view, at = self._config, self._view(self.done), self._at
        factor = self._schedule.image_factor(at)
        target, mask = self._cache.get(view, factor)
        formed, render_with_depth = None, partial(self._render, depth=True)
        if self._formation is not None:
            progress = at / config.planned
            formed = self._formation.form(view, factor, progress, target, mask, render_with_depth)
        weight = view.weight if formed is None else formed.weight
        weight *= self._pseudo_weight if view.kind == "pseudo" else 1.0
        camera = view.camera.scaled(factor) if formed is None else formed.camera
        render = self._render(camera, depth=formed is not None and formed.needs_depth)
        image = render.image if formed is None else formed.forward(render)
        self._log.seen(self.done, view, weight, target, self._gaussians.num, self._sh_degree())
        slope = self._measure(image, target, mask, weight)
        if config.densify and self._schedule.wants_errors(at):
            errors = self._shares_of_error(image, target, mask, weight, formed)
            self._errors = errors if self._errors is None else self._errors + errors
        gradients = self._rasteriser.backward(slope if formed is None else formed.backward(slope))
        self._backend.regularise(
            self._gaussians, gradients, opacity=config.opacity_reg, scale=config.scale_reg
        )
        step_gaussians(
            self._gaussians,
            gradients,
            self._moments,
            self._schedule.rates(at),
            step=self._before + self.done + 1,
        )
        if formed is not None:  # last, since it may have to wait for the device
            formed.learn()
        self.done += 1
        if config.densify:
            self._densify()

    def preview(self) -> Tensor:
        """The scene so far [H, W, 3], at the view that counts most, reduced; valid until the next step."""
        view = max(self._real or self._pseudo, key=lambda view: view.weight)
        camera = view.camera.scaled(min(1.0, PREVIEW_SIDE / max(view.camera.width, view.camera.height)))
        return self._render(camera, depth=False).image

    def shares_of_work(self) -> list[float]:
        """For 0 to ``length`` steps done, the share of the work that is behind us: growth makes later steps
        longer.
        """
        views = self._real or self._pseudo
        megapixels = sum(view.camera.width * view.camera.height for view in views) / len(views) / 1e6
        seconds = seconds_by_step(self._config, len(views), megapixels, self._scene.gaussians.num)
        return [0.0, *(np.cumsum(seconds) / seconds.sum()).tolist()]

    def _show(self, task: Task, shares: Sequence[float], rate: Rate) -> None:
        """Tell the progress bar iterations per second, PSNR and Gaussians.

        The rate counts from the first call on: the steps before may have waited for kernels to be compiled.
        """
        words = [f"training PSNR {self.last_psnr:.2f} dB", f"{self._gaussians.num} Gaussians"]
        if (steps := rate.per_second(self.done)) is not None:
            words.insert(0, f"{steps:.1f} it/s")
        task.update(done=self.done, note=", ".join(words), share=shares[self.done])

    def check_finite(self) -> None:
        """Raise StageError, naming the step and the group, when a parameter is NaN or infinite."""
        if fault := _fault(self._gaussians):
            raise self._stopped(fault)
        if self._formation is not None and (fault := self._formation.fault()):
            raise self._stopped(fault)

    def state(self) -> dict[str, Tensor]:
        """All that a training needs to resume: parameters, moments, affines, step and the log so far."""
        self._read_losses()
        state = {
            "fingerprint": self._fingerprint,
            "step": torch.tensor(self.done),
            "log": self._log.packed(self.done),
        }
        state |= {f"parameter.{name}": tensor for name, tensor in self._gaussians.tensors().items()}
        state |= self._moments.state()
        if self._errors is not None:
            state["strategy.errors"] = self._errors
        if self._formation is not None:
            state |= {f"formation.{name}": tensor for name, tensor in self._formation.state().items()}
        return state

    def wrote(self, state: dict[str, Tensor]) -> bool:
        """Whether ``state`` comes from a training with the same arguments."""
        return "fingerprint" in state and torch.equal(state["fingerprint"], self._fingerprint)

    def restore(self, state: dict[str, Tensor]) -> None:
        """Resume from what `state` returned, in a training with the same arguments."""
        self.done = int(state["step"])
        self._log.restore(state["log"])
        self._gaussians = Gaussians(**group(state, "parameter.")).to(self._device)
        self._moments = Moments.of_state(state).to(self._device)
        errors = state.get("strategy.errors")
        self._errors = None if errors is None else errors.to(self._device)
        if self._formation is not None:
            self._formation.restore(group(state, "formation."))

    def rows(self, round: int) -> pa.Table:
        """The log so far, one row a step."""
        self._read_losses()
        return self._log.table(self.done, round)

    def _view(self, step: int) -> TrainingView:
        """The view of a step: pseudo ones spread evenly at their share, both in shuffled epochs."""
        before = math.floor(step * self._share)
        if math.floor((step + 1) * self._share) > before:
            views, stream, count = self._pseudo, Stream.PSEUDO_VIEWS, before
        else:
            views, stream, count = self._real, Stream.REAL_VIEWS, step - before
        epoch, position = divmod(count, len(views))
        order = np.random.default_rng([*self._seed, stream, epoch]).permutation(len(views))
        return views[int(order[position])]

    def _render(self, camera: Camera, *, depth: bool) -> Render:
        return self._rasteriser.view(self.scene, camera, depth=depth, sh_degree=self._sh_degree())

    def _sh_degree(self) -> int:
        return self._schedule.sh_degree(self._at, self._gaussians.sh_degree)

    def _measure(self, image: Tensor, target: Tensor, mask: Tensor | None, weight: float) -> Tensor:
        """The gradient of the loss by the image; its value goes into the log, from a GPU with some delay."""
        size = (target.shape[0], target.shape[1])
        if size not in self._slopes:
            self._slopes[size] = torch.empty_like(target)
        slope = self._slopes[size]
        self._losses.add(self.done, image, target, mask, weight=weight, gradient=slope)
        if not support.on_gpu(self._device) or len(self._losses) >= _NOTE_INTERVAL:
            self._read_losses()
        return slope

    def _shares_of_error(
        self, image: Tensor, target: Tensor, mask: Tensor | None, weight: float, formed: Formed | None
    ) -> Tensor:
        """What each Gaussian contributes to the squared error of a frame, [N] >= 0.

        A Gaussian's share in a pixel is the pixel's derivative by its colour: the backward pass adds them up.
        """
        error = (image - target).square_().mul_(weight)
        if mask is not None:
            error *= mask[..., None]
        shares = self._rasteriser.backward(error if formed is None else formed.backward(error))
        return shares.sh[:, 0].sum(dim=1).clamp_(min=0.0)

    def _read_losses(self) -> None:
        """Bring the log up to date. Waits for the GPU."""
        for step, read in self._losses.take():
            self._log.measured(step, read)
            if not math.isfinite(read.loss):
                self.check_finite()
                raise self._stopped("the loss is not finite")

    def _densify(self) -> None:
        """Add the noise of a step, behind a refinement where one is due and errors say where."""
        config, at = self._config, self._at
        if self._schedule.refines(at):
            self.check_finite()  # a refinement takes one whose opacity is NaN for dead, and hides it
            if self._errors is not None:
                assert config.budget is not None  # decided at the start
                self._gaussians, self._moments = self._backend.refine(
                    self._gaussians,
                    self._moments,
                    errors=self._errors,
                    rate=config.growth,
                    budget=config.budget,
                    min_opacity=config.min_opacity,
                    seed=(*self._seed, Stream.REFINEMENT, at),
                )
                self._errors = None
        if config.noise > 0.0:
            self._backend.add_position_noise(
                self._gaussians,
                amount=config.noise * self._schedule.rate_of_means(at),
                min_opacity=config.min_opacity,
                seed=(*self._seed, Stream.POSITION_NOISE, at),
            )

    def _stopped(self, fault: str) -> StageError:
        return StageError(
            f"{fault} at step {self.done}; the last good checkpoint is kept",
            hint="lower the rates (lr_scales, lr_means), or give another --seed",
        )


def _fault(gaussians: Gaussians) -> str | None:
    """The first parameter that holds NaN or infinity, and in how many Gaussians; None where none does."""
    tensors = gaussians.tensors()
    if gaussians.device.type == "cpu":  # which NumPy tests far sooner
        finite = all(bool(np.isfinite(tensor.numpy()).all()) for tensor in tensors.values())
    else:  # waits for the GPU once
        finite = bool(torch.stack([torch.isfinite(tensor).all() for tensor in tensors.values()]).all())
    if finite:
        return None
    for name, tensor in tensors.items():
        sound = int(torch.isfinite(tensor).reshape(gaussians.num, -1).all(1).sum())
        if sound < gaussians.num:
            return f"{name} is not finite in {gaussians.num - sound} of {gaussians.num} Gaussians"
    return None


def _fingerprint(
    scene: Scene, views: Sequence[TrainingView], config: TrainConfig, starts: Sequence[float | str]
) -> Tensor:
    """A digest [32] of what a training starts from (pixels aside), by which its checkpoints are known."""
    settings = config.model_dump(mode="json", exclude={"checkpoint_interval", "cache_mb"})
    seen = []
    for view in views:
        *lens, pose = vars(view.camera).values()
        seen.append((view.frame_id, view.kind, view.weight, [*lens, *pose.ravel().tolist()]))
    parts = [settings, seen, scene.antialias, scene.background, list(starts)]
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode())
    for tensor in scene.gaussians.tensors().values():
        digest.update(tensor.detach().cpu().numpy().tobytes())
    return torch.tensor(list(digest.digest()), dtype=torch.uint8)


@contextmanager
def deferred_sigterm() -> Iterator[Callable[[], bool]]:
    """Hold SIGTERM back for the block, and yield a function that returns True once it came.

    The block is expected to save its state and to raise KeyboardInterrupt then. A cluster sends SIGTERM
    before a time limit, so that a job can save. Nothing is held back outside the main thread, where Python
    runs no signal handlers, nor in a program that does not answer SIGTERM itself.
    """
    asked = threading.Event()
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGTERM)
    if not in_main_thread or not callable(before):
        yield asked.is_set
        return
    signal.signal(signal.SIGTERM, lambda number, frame: asked.set())
    try:
        yield asked.is_set
    finally:
        signal.signal(signal.SIGTERM, before)
