"""The training of G0, RIVR and the consolidation: optimise a scene on weighted views.

A step does not use autograd: render -> loss and its gradient -> backward pass -> Adam -> densification.
Random numbers depend only on (seed, stream, step), so a resumed training has the same result.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from cleargs.errors import InputError, StageError
from cleargs.random_streams import Stream
from cleargs.splat.backend import LossAccumulator, backend_for
from cleargs.splat.budget import resolve_config, seconds_by_step
from cleargs.splat.camera import Camera
from cleargs.splat.config import TrainConfig
from cleargs.splat.densification import relative_error
from cleargs.splat.densifier import Densifier, DensifierState, load_densifier
from cleargs.splat.formation import SATURATED, Formation, Formed, clip_to_saturation
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cuda import support
from cleargs.splat.kernels.rasteriser import view_numbers
from cleargs.splat.scene import Colour, Scene
from cleargs.splat.schedule import Schedule, random_grey
from cleargs.splat.texture import TextureLoss, crop_of
from cleargs.splat.train_log import TrainLog
from cleargs.splat.types import Moments, Render, group
from cleargs.splat.views import ImageCache, TrainingView, require_views
from cleargs.timing import timed

NOTE_INTERVAL = 10  # steps between updates of the progress bar, and on a GPU between updates of the log

_PREVIEW_SIDE = 640  # maximum of the longer side of a preview, px


class Trainer:
    """A training of a scene on weighted views. `cleargs.splat.training.run` performs all steps.

    Raises:
        InputError: All weights are 0, or the scene is not finite.
    """

    def __init__(
        self,
        scene: Scene,  # to start from; it is copied
        views: Sequence[TrainingView],  # those with weight 0 are ignored
        config: TrainConfig,  # `resolve_config` sets its open numbers by the views
        *,
        seed: Sequence[int],
        formation: Formation | None = None,  # is updated; None: views are compared with plain renders
        moments: Moments | None = None,  # Adam's, at the end of the previous part of the schedule; None: zero
        pseudo_share: float = 0.0,  # fraction of the steps that use a pseudo view
        pseudo_weight: float = 1.0,  # factor on the loss of pseudo views
        device: str = "cpu",  # or ``cuda``
    ) -> None:
        weighted = [view for view in views if view.weight > 0.0]
        self._real = [view for view in weighted if view.kind == "real"]
        self._pseudo = [view for view in weighted if view.kind == "pseudo"]
        require_views(weighted)
        self._pseudo_share = pseudo_share if self._real and self._pseudo else float(bool(self._pseudo))
        self._pseudo_weight = pseudo_weight
        self._config = config = resolve_config(config, self._real or self._pseudo)
        self.length = config.length
        self.checkpoint_interval = config.checkpoint_interval
        self._seed = tuple(seed)
        self._scene = scene
        self._device = torch.device(device)
        self._backend = backend_for(self._device)
        self._rasteriser = self._backend.rasteriser(self._device)
        self._gaussians = scene.gaussians.detach().clone().to(self._device)
        if fault := self._gaussians.fault():
            raise InputError(
                f"the initial scene is damaged: {fault}", hint="repeat the stage that wrote it with --force"
            )
        self._moments = Moments.zeros(self._gaussians) if moments is None else moments.to(self._device)
        self._earlier_steps = 0 if moments is None else config.first
        self._schedule = Schedule(config)
        self._densifier = load_densifier(config)
        self._errors: Tensor | None = None  # [N], see `DensifierState`
        self._formation = formation
        self._cache = ImageCache(config.cache_mb * 2**20, self._device, training=True)
        self._losses = LossAccumulator(self._device, config.ssim_lambda, saturated=SATURATED)
        self._texture = TextureLoss(self._device) if config.texture > 0.0 else None
        self._log = TrainLog(self.length)
        self._image_gradients: dict[tuple[int, int], Tensor] = {}
        others: list[float | str] = [*self._seed, self._earlier_steps, self._pseudo_share, pseudo_weight]
        others.append("" if formation is None else formation.digest())
        self._fingerprint = _fingerprint(scene, weighted, config, others)
        self.done = 0

    @property
    def scene(self) -> Scene:
        """Current scene; it shares memory with the trainer."""
        return replace(self._scene, gaussians=self._gaussians)

    @property
    def _schedule_step(self) -> int:
        """Number of finished steps of the schedule."""
        return self._config.first + self.done

    @property
    def last_psnr(self) -> float:
        """Mean PSNR over the last 50 steps, dB."""
        self._read_losses()
        return self._log.recent_psnr(self.done)

    def step(self) -> None:
        """Run one iteration: one view, one step of Adam and densification if it is due."""
        config, view, schedule_step = self._config, self._view(self.done), self._schedule_step
        factor = self._schedule.image_factor(schedule_step)
        with timed("reading images"):
            target, mask = self._cache.get(view, factor)
        alpha = self._cache.alpha
        colour = random_grey(self._seed, schedule_step) if config.background is None else None
        formed, renders = (
            None,
            _StepRenders(partial(self._render, depth=True), colour, self._scene.background),
        )
        if self._formation is not None:
            progress = schedule_step / config.planned
            opaque = mask if alpha is None else _both(mask, alpha > 0.5)
            with timed("search for the formation"):
                formed = self._formation.form(view, factor, progress, target, opaque, renders.render)
        weight = view.weight if formed is None else formed.weight
        weight *= self._pseudo_weight if view.kind == "pseudo" else 1.0
        camera = view.camera.scaled(factor) if formed is None else formed.camera
        depth = formed is not None and formed.needs_depth
        render = renders.last_of(camera) or self._render(camera, depth=depth, background=colour)
        with timed("image formation"):
            image = render.image if formed is None else formed.forward(render)
        if alpha is None:
            mask = mask if formed is None else formed.mask
        else:
            affine = None if formed is None else formed.affine
            target = _over(target, alpha, colour or self._scene.background, affine)
            mask = mask if formed is None else _with_empty(formed.mask, mask, alpha)
        self._log.add_view(self.done, view, weight, target, self._gaussians.num, self._sh_degree())
        with timed("loss"):
            gradient = self._add_loss(image, target, mask, weight)
        if self._texture is not None and self._schedule.sees_texture(schedule_step):
            crop = crop_of(self._seed, schedule_step, *target.shape[:2])
            share = config.texture * weight * image[crop].numel() / image.numel()
            hidden = None if mask is None else mask[crop]
            recorded, too_bright = clip_to_saturation(image[crop], target[crop])
            with timed("texture"):
                slope = share * self._texture.gradient(recorded, target[crop], hidden)
                gradient[crop] += slope.masked_fill_(too_bright, 0.0)
        if self._densifier is not None and self._densifier.wants_errors(schedule_step):
            with timed("errors of the Gaussians"):
                errors = self._error_per_gaussian(image, target, mask, weight, formed)
            self._errors = errors if self._errors is None else self._errors + errors
        with timed("image formation"):
            gradient = gradient if formed is None else formed.backward(gradient)
        with timed("backward pass"):
            gradients = self._rasteriser.backward(gradient)
        with timed("optimiser"):
            self._backend.step_gaussians(
                self._gaussians,
                gradients,
                self._moments,
                self._schedule.rates(schedule_step),
                step=self._earlier_steps + self.done + 1,
                opacity=config.opacity_reg,
                scale=config.scale_reg,
            )
        if formed is not None:  # last, because it may wait for the device
            formed.learn()
        self.done += 1
        if self._densifier is not None:
            with timed("densification"):
                self._densify(self._densifier)

    def preview(self) -> Tensor:
        """Return a small render [H, W, 3] sRGB of the view with the largest weight. The next replaces it."""
        view = max(self._real or self._pseudo, key=lambda view: view.weight)
        camera = view.camera.scaled(min(1.0, _PREVIEW_SIDE / max(view.camera.width, view.camera.height)))
        return self._render(camera, depth=False).image

    def work_fractions(self) -> list[float]:
        """Return the finished fraction of the work after 0 to ``length`` steps; later steps take longer."""
        views = self._real or self._pseudo
        megapixels = sum(view.camera.width * view.camera.height for view in views) / len(views) / 1e6
        seconds = seconds_by_step(self._config, len(views), megapixels, self._scene.gaussians.num)
        return [0.0, *(np.cumsum(seconds) / seconds.sum()).tolist()]

    def check_finite(self) -> None:
        """Raise StageError with the step and the parameter if a value is NaN or infinite."""
        fault = self._gaussians.fault()
        if fault is None and self._formation is not None:
            fault = self._formation.fault()
        if fault is not None:
            raise self._error_at_step(fault)

    def state(self) -> dict[str, Tensor]:
        """Return the tensors of a checkpoint: parameters, moments, image formation, step and log."""
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

    def matches(self, state: dict[str, Tensor]) -> bool:
        """Return True if ``state`` comes from a training with the same arguments."""
        return "fingerprint" in state and torch.equal(state["fingerprint"], self._fingerprint)

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continue from the result of `state` in a training with the same arguments."""
        self.done = int(state["step"])
        self._log.restore(state["log"])
        self._gaussians = Gaussians(**group(state, "parameter.")).to(self._device)
        self._moments = Moments.of_state(state).to(self._device)
        errors = state.get("strategy.errors")
        self._errors = None if errors is None else errors.to(self._device)
        if self._formation is not None:
            self._formation.restore(group(state, "formation."))

    def rows(self, round: int) -> pa.Table:
        """Return the log, one row per finished step, with ``round`` in its column."""
        self._read_losses()
        return self._log.table(self.done, round)

    def _view(self, step: int) -> TrainingView:
        """Return the view of a step. Pseudo views are evenly spaced; both kinds come in shuffled epochs."""
        before = math.floor(step * self._pseudo_share)
        if math.floor((step + 1) * self._pseudo_share) > before:
            views, stream, count = self._pseudo, Stream.PSEUDO_VIEWS, before
        else:
            views, stream, count = self._real, Stream.REAL_VIEWS, step - before
        epoch, position = divmod(count, len(views))
        order = np.random.default_rng([*self._seed, stream, epoch]).permutation(len(views))
        return views[int(order[position])]

    def _render(self, camera: Camera, *, depth: bool, background: Colour | None = None) -> Render:
        """Render the scene over ``background`` (None: its own)."""
        scene = self.scene if background is None else replace(self.scene, background=background)
        with timed("rendering"):
            return self._rasteriser.view(scene, camera, depth=depth, sh_degree=self._sh_degree())

    def _sh_degree(self) -> int:
        return self._schedule.sh_degree(self._schedule_step, self._gaussians.sh_degree)

    def _add_loss(self, image: Tensor, target: Tensor, mask: Tensor | None, weight: float) -> Tensor:
        """Return the gradient with respect to the image, and log the loss (on a GPU with a delay)."""
        size = (target.shape[0], target.shape[1])
        if size not in self._image_gradients:
            self._image_gradients[size] = torch.empty_like(target)
        gradient = self._image_gradients[size]
        self._losses.add(self.done, image, target, mask, weight=weight, gradient=gradient)
        if not support.on_gpu(self._device) or len(self._losses) >= NOTE_INTERVAL:
            self._read_losses()
        return gradient

    def _error_per_gaussian(
        self, image: Tensor, target: Tensor, mask: Tensor | None, weight: float, formed: Formed | None
    ) -> Tensor:
        """Return the contribution of each Gaussian to the error of a frame, [N] >= 0.

        The weight of a Gaussian in a pixel is the derivative of the pixel with respect to its colour, so the
        backward pass sums weight times error over the pixels.
        """
        recorded, _ = clip_to_saturation(image, target)
        error = relative_error(recorded, target, mask).mul_(weight)
        gradients = self._rasteriser.backward(error if formed is None else formed.backward(error))
        return gradients.sh[:, 0].sum(dim=1).clamp_(min=0.0)

    def _read_losses(self) -> None:
        """Add pending losses to the log; waits for the GPU."""
        for step, read in self._losses.take():
            self._log.add_losses(step, read)
            if not math.isfinite(read.loss):
                self.check_finite()
                raise self._error_at_step("the loss is not finite")

    def _densify(self, densifier: Densifier) -> None:
        """Let the strategy change the Gaussians after a step."""
        state = DensifierState(
            self._gaussians,
            self._moments,
            self._errors,
            self._schedule_step,
            self._seed,
            self._schedule.rate_of_means(self._schedule_step),
            self.check_finite,
        )
        densifier.after_step(state)
        self._gaussians, self._moments, self._errors = state.gaussians, state.moments, state.errors

    def _error_at_step(self, fault: str) -> StageError:
        return StageError(
            f"{fault} at step {self.done}; the last good checkpoint is kept",
            hint="lower the rates (lr_scales, lr_means), or use another --seed",
        )


class _StepRenders:
    """Renders for image formation within one step. The step reuses the last one if the camera is the same."""

    def __init__(self, render: Callable[..., Render], colour: Colour | None, background: Colour) -> None:
        self._render, self._colour, self._background = render, colour, background
        self._last: Render | None = None
        self._seen_by: list[float] = []

    def render(self, camera: Camera) -> Render:
        """Return a render with depth over the background of the scene."""
        render = self._render(camera, background=self._colour)
        self._last, self._seen_by = render, _numbers(camera)
        if self._colour is None:
            return render
        change = torch.tensor(self._background) - torch.tensor(self._colour)
        empty = (1.0 - render.alpha)[..., None]
        return render._replace(image=render.image + empty * change.to(empty.device))

    def last_of(self, camera: Camera) -> Render | None:
        """Return the last render, over the colour of the step, if its camera equals ``camera``; else None."""
        return self._last if self._last is not None and self._seen_by == _numbers(camera) else None


def _both(mask: Tensor | None, other: Tensor) -> Tensor:
    return other if mask is None else mask & other


def _with_empty(opaque: Tensor | None, mask: Tensor | None, alpha: Tensor) -> Tensor | None:
    """Return the pixels [H, W] of ``opaque``, and the empty ones of ``mask``; None: all count."""
    return opaque if opaque is None else opaque | _both(mask, alpha <= 0.5)


def _over(cut_out: Tensor, alpha: Tensor, behind: Colour, affine: Tensor | None) -> Tensor:
    """Return a picture [H, W, 3], multiplied by its ``alpha`` [H, W], over a colour of the background.

    ``affine`` [3, 4] maps that colour to the one in the picture.
    """
    colour = torch.tensor(behind)
    if affine is not None:
        colour = affine[:, :3].cpu() @ colour + affine[:, 3].cpu()
    return cut_out + (1.0 - alpha)[..., None] * colour.to(alpha.device)


def _numbers(camera: Camera) -> list[float]:
    rolling = [] if camera.readout is None else camera.readout.numbers()
    return [camera.width, camera.height, *view_numbers(camera), *rolling]


def _fingerprint(
    scene: Scene, views: Sequence[TrainingView], config: TrainConfig, others: Sequence[float | str]
) -> Tensor:
    """Return a digest [32] of the arguments of a training, except pixels. It identifies checkpoints."""
    settings = config.model_dump(mode="json", exclude={"checkpoint_interval", "cache_mb"})
    seen = []
    for view in views:
        seen.append((view.frame_id, view.kind, view.weight, view.time, _numbers(view.camera)))
    parts = [settings, seen, scene.antialias, scene.background, list(others)]
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode())
    for tensor in scene.gaussians.tensors().values():
        digest.update(tensor.detach().cpu().numpy().tobytes())
    return torch.tensor(list(digest.digest()), dtype=torch.uint8)
