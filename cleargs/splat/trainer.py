"""Optimise a scene against weighted views: the one loop that G0, RIVR and the consolidation share.

No torch autograd: engine forward -> loss and its gradient -> engine backward -> Adam -> densification. All
randomness is drawn afresh from (seed, purpose, step), so that a resumed training is the same training.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.errors import InputError, StageError
from cleargs.progress import Reporter, Task
from cleargs.splat import strategy
from cleargs.splat.compensation import Exposure
from cleargs.splat.config import TrainConfig
from cleargs.splat.engine import Engine
from cleargs.splat.exposure import affine_backward, apply_affine
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.losses import photometric_loss, psnr
from cleargs.splat.optimiser import ExposureOptimiser, Moments, Rates, step_gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.state import load_state, save_state
from cleargs.splat.tables import TRAIN
from cleargs.splat.views import ImageCache, View, require_views

_REAL, _PSEUDO, _REFINE, _NOISE = range(4)
"""Purposes of random numbers."""

_LOG = np.dtype(
    [
        ("frame_id", np.int32),
        ("pseudo", np.bool_),
        ("weight", np.float32),
        ("width", np.int32),
        ("height", np.int32),
        ("loss", np.float64),
        ("l1", np.float64),
        ("ssim", np.float64),
        ("psnr", np.float64),
        ("n_gaussians", np.int32),
        ("sh_degree", np.int32),
    ]
)

_NOTE_INTERVAL = 10
"""Steps between updates of the progress bar."""

_CHECK_INTERVAL = 10
"""Steps between looks for NaN and infinity (under 1 ms for 50,000 Gaussians)."""


@dataclass(frozen=True)
class Trained:
    """What a training leaves."""

    scene: Scene
    exposure: Exposure | None
    """The learned affines; None where exposure was off."""
    rows: pa.Table
    """One row a step, schema `cleargs.splat.tables.TRAIN`."""
    state: dict[str, Tensor]
    """All that a continuation needs, for ``state.safetensors``."""


def train(
    scene: Scene,
    views: Sequence[View],
    config: TrainConfig,
    *,
    seed: Sequence[int],
    exposure: Exposure | None = None,
    pseudo_share: float = 0.0,
    pseudo_weight: float = 1.0,
    checkpoint: Path,
    reporter: Reporter,
    label: str = "training",
    round: int = 0,
    device: str = "cpu",
) -> Trained:
    """Train ``scene`` on ``views`` for ``config.steps`` steps with fresh Adam moments.

    ``seed`` is the only source of randomness. ``exposure`` None trains without affines; otherwise those given
    go on being learned. A share ``pseudo_share`` of the steps draws a pseudo view, whose loss is multiplied
    by ``pseudo_weight``. Goes on from ``checkpoint`` where there is one, to the same result bit for bit.

    Raises InputError when no view has a weight or the scene is not finite, StageError when a parameter or the
    loss ceases to be finite.
    """
    trainer = Trainer(
        scene,
        views,
        config,
        seed=seed,
        exposure=exposure,
        pseudo_share=pseudo_share,
        pseudo_weight=pseudo_weight,
        device=device,
    )
    saved = load_state(checkpoint, reporter)
    if saved is not None and not trainer.wrote(saved):
        reporter.warn(f"ignoring {checkpoint.name}: it belongs to another training")
    elif saved is not None:
        trainer.restore(saved)
        reporter.info(f"{label}: going on from step {trainer.done} of {config.steps}")
    with reporter.task(label, total=config.steps) as task:
        progress = _Progress(task, trainer)
        while trainer.done < config.steps:
            trainer.step()
            due = trainer.done % config.checkpoint_interval == 0 and trainer.done < config.steps
            if trainer.done % _NOTE_INTERVAL == 0:
                progress.show()
            if due or trainer.done % _CHECK_INTERVAL == 0:
                trainer.check_finite()
            if due:
                save_state(checkpoint, trainer.state())
        trainer.check_finite()
        progress.show()
    return Trained(trainer.scene, trainer.exposure, trainer.rows(round), trainer.state())


class Trainer:
    """The state of one training; `step` is one iteration. Use `train` unless you need to look inside."""

    def __init__(
        self,
        scene: Scene,
        views: Sequence[View],
        config: TrainConfig,
        *,
        seed: Sequence[int],
        exposure: Exposure | None = None,
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
        self._config = config
        self._seed = tuple(seed)
        self._scene = scene
        self._gaussians = scene.gaussians.detach().clone()
        if fault := _fault(self._gaussians):
            raise InputError(
                f"the scene to start from is damaged: {fault}",
                hint="run the stage that made it again with --force",
            )
        self._moments = Moments.zeros(self._gaussians)
        self._rates = Rates(config, self._gaussians.sh.shape[1])
        self._budget = config.budget or strategy.budget_from_pixels(
            sum(view.camera.width * view.camera.height for view in self._real or self._pseudo)
        )
        self._exposure = (
            None if exposure is None else _exposure_optimiser(exposure, weighted, config.lr_exposure)
        )
        self._engine = Engine(device)
        self._cache = ImageCache(config.cache_mb * 2**20)
        self._log = np.zeros(config.steps, _LOG)
        self._slopes: dict[tuple[int, int], Tensor] = {}
        self._fingerprint = _fingerprint(scene, weighted, config, [*self._seed, self._share, pseudo_weight])
        self.done = 0

    @property
    def scene(self) -> Scene:
        """The scene as trained so far (shares memory with the trainer)."""
        return replace(self._scene, gaussians=self._gaussians)

    @property
    def exposure(self) -> Exposure | None:
        """The affines learned so far; None where exposure is off."""
        return None if self._exposure is None else self._exposure.exposure

    @property
    def last_psnr(self) -> float:
        """Mean PSNR over the last 50 steps, dB."""
        recent = self._log["psnr"][max(0, self.done - 50) : self.done]
        return float(recent.mean()) if len(recent) else math.nan

    def step(self) -> None:
        """One iteration: one view, one Adam step, and what densification is due."""
        config, view = self._config, self._view(self.done)
        factor = config.coarse_factor if self.done < config.coarse_share * config.steps else 1.0
        target, mask = self._cache.get(view, factor)
        weight = view.weight * (self._pseudo_weight if view.kind == "pseudo" else 1.0)
        sh_degree = self._sh_degree()
        render = self._engine.forward(
            self._gaussians,
            view.camera.scaled(factor),
            sh_degree=sh_degree,
            background=self._scene.background,
            antialias=self._scene.antialias,
        )
        image = render.image
        if self._exposure is not None:
            affine = self._exposure.affine(view.frame_id)
            image = apply_affine(render.image, affine)
        loss = photometric_loss(
            image,
            target,
            ssim_lambda=config.ssim_lambda,
            weight=weight,
            mask=mask,
            gradient=self._slope(target),
        )
        self._log[self.done] = (
            view.frame_id,
            view.kind == "pseudo",
            weight,
            target.shape[1],
            target.shape[0],
            loss.loss,
            loss.l1,
            loss.ssim,
            psnr(image, target, mask),
            self._gaussians.num,
            sh_degree,
        )
        if not math.isfinite(loss.loss):
            self.check_finite()
            raise self._stopped("the loss is not finite")
        slope = loss.grad_image
        if self._exposure is not None:
            slope, affine_slope = affine_backward(render.image, affine, slope)
            self._exposure.step(view.frame_id, np.asarray(affine_slope, np.float64))
        gradients = self._engine.backward(slope)
        _regularise(self._gaussians, gradients, config)
        step_gaussians(
            self._gaussians, gradients, self._moments, self._rates.at(self.done), step=self.done + 1
        )
        self.done += 1
        if config.densify:
            self._densify()

    def check_finite(self) -> None:
        """Raise StageError, naming the step and the group, when a parameter is NaN or infinite."""
        if fault := _fault(self._gaussians):
            raise self._stopped(fault)
        if self._exposure is not None and not np.isfinite(self._exposure.affines).all():
            raise self._stopped("exposure is not finite")

    def state(self) -> dict[str, Tensor]:
        """All that a training needs to go on: parameters, moments, affines, step and the log so far."""
        state = {
            "fingerprint": self._fingerprint,
            "step": torch.tensor(self.done),
            "log": torch.from_numpy(self._log[: self.done].view(np.uint8).copy()),
        }
        groups = (self._gaussians.tensors(), self._moments.first, self._moments.second)
        for prefix, group in zip(("parameter", "first", "second"), groups, strict=True):
            state |= {f"{prefix}.{name}": tensor for name, tensor in group.items()}
        if self._exposure is not None:
            state |= {
                f"exposure.{name}": torch.from_numpy(array) for name, array in self._exposure.arrays().items()
            }
        return state

    def wrote(self, state: dict[str, Tensor]) -> bool:
        """Whether ``state`` comes from a training with the same arguments."""
        return "fingerprint" in state and torch.equal(state["fingerprint"], self._fingerprint)

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on from what `state` returned, in a training with the same arguments."""

        def group(prefix: str) -> dict[str, Tensor]:
            return {
                key.split(".", 1)[1]: value for key, value in state.items() if key.startswith(f"{prefix}.")
            }

        self.done = int(state["step"])
        self._log[: self.done] = state["log"].numpy().view(_LOG)
        self._gaussians = Gaussians(**group("parameter"))
        self._moments = Moments(group("first"), group("second"))
        if self._exposure is not None:
            self._exposure.restore({name: tensor.numpy() for name, tensor in group("exposure").items()})

    def rows(self, round: int) -> pa.Table:
        """The log so far, one row a step."""
        log = self._log[: self.done]
        columns: dict[str, Any] = {
            "round": np.full(self.done, round),
            "step": np.arange(1, self.done + 1),
            "kind": np.where(log["pseudo"], "pseudo", "real"),
        }
        columns |= {name: log[name] for name in _LOG.names or () if name != "pseudo"}
        return pa.table({name: pa.array(columns[name]) for name in TRAIN.names}).cast(TRAIN)

    def _view(self, step: int) -> View:
        """The view of a step: pseudo ones spread evenly at their share, both in shuffled epochs."""
        before = math.floor(step * self._share)
        if math.floor((step + 1) * self._share) > before:
            views, purpose, count = self._pseudo, _PSEUDO, before
        else:
            views, purpose, count = self._real, _REAL, step - before
        epoch, position = divmod(count, len(views))
        order = self._rng(purpose, epoch).permutation(len(views))
        return views[int(order[position])]

    def _sh_degree(self) -> int:
        interval = self._config.sh_interval
        largest = self._gaussians.sh_degree
        return largest if interval == 0 else min(largest, self.done // interval)

    def _densify(self) -> None:
        """Relocate and grow where a refinement is due, then shake the means."""
        config, step = self._config, self.done
        names = list(self._gaussians.tensors())
        if (
            step % config.refine_interval == 0
            and config.refine_start * config.steps <= step <= config.refine_stop * config.steps
        ):
            self.check_finite()  # relocation takes a Gaussian whose opacity is NaN for dead, and hides it
            rng = self._rng(_REFINE, step)
            arrays = {name: tensor.numpy() for name, tensor in self._gaussians.tensors().items()}
            moments = [
                {name: tensor.numpy() for name, tensor in group.items()}
                for group in (self._moments.first, self._moments.second)
            ]
            strategy.relocate(arrays, moments, min_opacity=config.min_opacity, rng=rng)
            arrays, moments = strategy.grow(
                arrays,
                moments,
                rate=config.growth,
                budget=self._budget,
                min_opacity=config.min_opacity,
                rng=rng,
            )
            self._gaussians = Gaussians(**{name: torch.from_numpy(arrays[name]) for name in names})
            first, second = ({name: torch.from_numpy(group[name]) for name in names} for group in moments)
            self._moments = Moments(first, second)
        if config.noise > 0.0:
            felt, offsets = strategy.mean_noise(
                self._gaussians.log_scales.numpy(),
                self._gaussians.rotations.numpy(),
                self._gaussians.logit_opacities.numpy(),
                amount=config.noise * self._rates.means(step),
                min_opacity=config.min_opacity,
                rng=self._rng(_NOISE, step),
            )
            self._gaussians.means.numpy()[felt] += offsets

    def _slope(self, target: Tensor) -> Tensor:
        """A buffer for the gradient of the loss with respect to the image."""
        size = (target.shape[0], target.shape[1])
        if size not in self._slopes:
            self._slopes[size] = torch.empty_like(target)
        return self._slopes[size]

    def _rng(self, purpose: int, count: int) -> np.random.Generator:
        return np.random.default_rng([*self._seed, purpose, count])

    def _stopped(self, fault: str) -> StageError:
        return StageError(
            f"{fault} at step {self.done}; the last good checkpoint is kept",
            hint="lower the rates (lr_scales, lr_means), or give another --seed",
        )


def _fault(gaussians: Gaussians) -> str | None:
    """The first parameter that holds NaN or infinity, and in how many Gaussians; None where none does."""
    for name, tensor in gaussians.tensors().items():
        finite = np.isfinite(tensor.numpy())
        if not finite.all():
            sound = finite.reshape(gaussians.num, -1).all(axis=1).sum()
            return f"{name} is not finite in {gaussians.num - sound} of {gaussians.num} Gaussians"
    return None


def render_view(
    scene: Scene, view: View, exposure: Exposure | None = None, *, engine: Engine | None = None
) -> Tensor:
    """What ``scene`` shows at a view, through the frame's affine: [H, W, 3] sRGB in [0, 1], own memory."""
    engine = engine or Engine(str(scene.gaussians.device))
    image = engine.forward(
        scene.gaussians, view.camera, background=scene.background, antialias=scene.antialias
    ).image
    if exposure is not None:
        image = apply_affine(image, torch.from_numpy(exposure.of(view.frame_id).astype(np.float32)))
    return image.clamp(0.0, 1.0)


def evaluate_views(
    scene: Scene,
    views: Sequence[View],
    exposure: Exposure | None = None,
    *,
    engine: Engine | None = None,
    cache: ImageCache | None = None,
) -> list[float]:
    """PSNR in dB of the scene at every view, in their order, over unmasked pixels, at full size."""
    engine = engine or Engine(str(scene.gaussians.device))
    cache = cache or ImageCache(0)
    values = []
    for view in views:
        target, mask = cache.get(view)
        values.append(psnr(render_view(scene, view, exposure, engine=engine), target, mask))
    return values


class _Progress:
    """Iterations a second, PSNR and Gaussians, for the progress bar alone (which adds the time left)."""

    def __init__(self, task: Task, trainer: Trainer) -> None:
        self._task, self._trainer = task, trainer
        self._start, self._first = time.perf_counter(), trainer.done

    def show(self) -> None:
        trainer, elapsed = self._trainer, time.perf_counter() - self._start
        rate = (trainer.done - self._first) / max(elapsed, 1e-9)
        count = trainer.scene.gaussians.num
        note = f"{rate:.1f} it/s, PSNR {trainer.last_psnr:.2f} dB, {count} Gaussians"
        self._task.update(done=trainer.done, note=note)


def _fingerprint(
    scene: Scene, views: Sequence[View], config: TrainConfig, numbers: Sequence[float]
) -> Tensor:
    """A digest [32] of what a training starts from (pixels aside), by which its checkpoints are known."""
    settings = config.model_dump(mode="json", exclude={"checkpoint_interval", "cache_mb"})
    seen = [(view.frame_id, view.kind, view.weight, view.camera.width, view.camera.height) for view in views]
    digest = hashlib.sha256(json.dumps([settings, seen, list(numbers)], sort_keys=True).encode())
    for tensor in scene.gaussians.tensors().values():
        digest.update(tensor.detach().numpy().tobytes())
    return torch.tensor(list(digest.digest()), dtype=torch.uint8)


def _regularise(gaussians: Gaussians, gradients: Gaussians, config: TrainConfig) -> None:
    """Add to the gradients those of opacity_reg * mean(opacity) + scale_reg * mean(scale) (3DGS-MCMC)."""
    if config.opacity_reg > 0.0:
        opacity = strategy.sigmoid(gaussians.logit_opacities.numpy())
        gradients.logit_opacities.numpy()[:] += (
            np.float32(config.opacity_reg / gaussians.num) * opacity * (1 - opacity)
        )
    if config.scale_reg > 0.0:
        scales = np.exp(gaussians.log_scales.numpy())
        gradients.log_scales.numpy()[:] += np.float32(config.scale_reg / scales.size) * scales


def _exposure_optimiser(exposure: Exposure, views: Sequence[View], rate: float) -> ExposureOptimiser:
    """Affines for every frame given or seen; the mean counts the weights of the real views."""
    frame_ids = np.union1d(exposure.frame_ids, [view.frame_id for view in views]).astype(np.int32)
    weights: NDArray[np.float64] = np.zeros(len(frame_ids))
    for view in views:
        if view.kind == "real":
            weights[np.searchsorted(frame_ids, view.frame_id)] = view.weight
    known = Exposure(frame_ids, np.stack([exposure.of(int(frame_id)) for frame_id in frame_ids]))
    return ExposureOptimiser(known, weights, rate)
