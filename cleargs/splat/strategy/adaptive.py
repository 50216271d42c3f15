"""Adaptive density control of "3D Gaussian Splatting" (Kerbl et al. 2023), as the Inria code does it.

Where the loss pulls a Gaussian about on the screen, small ones are cloned and large ones split in two; faint
ones are removed, and all opacities are lowered now and then, so that what is not needed fades away. Beyond
the Inria code there is a budget: the strongest pulled come first. What is large on the screen is not removed,
as in gsplat.

The rules are functions of numpy arrays: one thread. On a GPU the arrays are fetched at each refinement.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.random_streams import Stream
from cleargs.splat.adam import Moments
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.strategy.base import Strategy
from cleargs.splat.strategy.mcmc import Arrays, rotation_matrices, sigmoid

if TYPE_CHECKING:
    from cleargs.splat.camera import Camera
    from cleargs.splat.config import TrainConfig
    from cleargs.splat.engine import Engine

SPLIT_SCALE = 1.6
"""The two halves of a Gaussian are smaller by it."""


class AdaptiveDensityControl(Strategy):
    """See the module. It remembers the gradients since the last refinement."""

    def __init__(self, config: TrainConfig, budget: int, seed: Sequence[int]) -> None:
        self._config = config
        self._budget = budget
        self._seed = tuple(seed)
        self._pull: Tensor | None = None  # [2, N] sum of the lengths of the gradients, and of how many

    def observe(self, engine: Engine, camera: Camera) -> None:
        """Add up the gradients by the place on a screen that is 2 wide and high."""
        gradient = engine.screen_gradients()
        x, y = gradient[:, 0] * (0.5 * camera.width), gradient[:, 1] * (0.5 * camera.height)
        if self._pull is None:
            self._pull = gradient.new_zeros(2, len(gradient))
        self._pull[0] += (x * x + y * y).sqrt()
        self._pull[1] += engine.visible

    def refine(self, gaussians: Gaussians, moments: Moments, step: int) -> tuple[Gaussians, Moments]:
        """Clone, split, remove, and lower the opacities where that is due."""
        config, device = self._config, gaussians.device
        arrays, *running = (
            {name: tensor.cpu().numpy() for name, tensor in group.items()}
            for group in (gaussians.tensors(), moments.first, moments.second)
        )
        if self._pull is not None:
            total, seen = self._pull.cpu().numpy()
            rng = np.random.default_rng([*self._seed, Stream.REFINEMENT, step])
            grad, dense = config.adaptive.grad, config.adaptive.dense
            pull = total / np.maximum(seen, 1)
            arrays, running = densify(
                arrays, running, pull, grad=grad, dense=dense, budget=self._budget, rng=rng
            )
        interval = round(config.adaptive.reset * config.planned)
        large = config.adaptive.large if interval and step > interval else np.inf
        arrays, running = prune(arrays, running, min_opacity=config.min_opacity, large=large)
        since = step - config.refine_interval
        if interval and step // interval > since // interval and step < config.refine_stop * config.planned:
            lower_opacities(arrays, running, 2.0 * config.min_opacity)
        self._pull = None
        grown, first, second = (
            {name: torch.from_numpy(array).to(device) for name, array in group.items()}
            for group in (arrays, *running)
        )
        return Gaussians(**grown), Moments(first, second)

    def state(self) -> dict[str, Tensor]:
        """The gradients since the last refinement."""
        return {} if self._pull is None else {"pull": self._pull}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Resume from what `state` gave."""
        self._pull = state.get("pull")


def densify(
    arrays: Arrays,
    moments: Sequence[Arrays],
    pull: NDArray[np.float32],  # [N]
    *,
    grad: float,
    dense: float,
    budget: int,
    rng: np.random.Generator,
) -> tuple[Arrays, list[Arrays]]:
    """Clone or split every Gaussian that is pulled by ``grad`` or more, the strongest up to ``budget``.

    One of a scale up to ``dense`` is cloned in its place; a larger one gives way to two, smaller by
    SPLIT_SCALE, at places drawn from it. Returns new arrays and moments; those of new Gaussians are 0.
    """
    count = len(pull)
    wanted = np.flatnonzero(pull >= grad)
    wanted = np.sort(wanted[np.argsort(-pull[wanted], kind="stable")[: max(0, budget - count)]])
    small = np.exp(arrays["log_scales"][wanted]).max(axis=1) <= dense
    cloned, split = wanted[small], wanted[~small]
    kept = np.delete(np.arange(count), split)
    sources = np.concatenate([kept, cloned, split, split])
    grown = {name: array[sources] for name, array in arrays.items()}
    halves = slice(len(kept) + len(cloned), None)
    scales = np.exp(grown["log_scales"][halves])
    draw = rng.standard_normal(scales.shape, dtype=np.float32) * scales
    rotation = rotation_matrices(grown["rotations"][halves])
    grown["means"][halves] += (rotation * draw[:, None, :]).sum(axis=2)
    grown["log_scales"][halves] -= np.float32(np.log(SPLIT_SCALE))
    running = [{name: array[sources] for name, array in moment.items()} for moment in moments]
    for moment in running:
        for array in moment.values():
            array[len(kept) :] = 0
    return grown, running


def prune(
    arrays: Arrays, moments: Sequence[Arrays], *, min_opacity: float, large: float
) -> tuple[Arrays, list[Arrays]]:
    """Leave out what is fainter than ``min_opacity`` or larger than ``large``, unless that is all."""
    opacity = sigmoid(arrays["logit_opacities"].astype(np.float64))
    keep = (opacity > min_opacity) & (np.exp(arrays["log_scales"]).max(axis=1) <= large)
    if not keep.any():
        return arrays, list(moments)
    kept = {name: array[keep] for name, array in arrays.items()}
    return kept, [{name: array[keep] for name, array in moment.items()} for moment in moments]


def lower_opacities(arrays: Arrays, moments: Sequence[Arrays], max_opacity: float) -> None:
    """No opacity stays above ``max_opacity``; Adam forgets how they moved. In place."""
    limit = np.float32(np.log(max_opacity) - np.log1p(-max_opacity))
    np.minimum(arrays["logit_opacities"], limit, out=arrays["logit_opacities"])
    for moment in moments:
        moment["logit_opacities"][:] = 0
