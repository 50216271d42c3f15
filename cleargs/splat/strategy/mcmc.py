"""Densification after "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand et al. 2024).

As gsplat's MCMCStrategy does it, dead Gaussians move onto live ones, the number grows to a hard budget, and
noise that only transparent Gaussians feel is added to the means. But growth follows the error: what takes
part in pixels that are far from their frames (Rota Bulò et al., "Revising densification in Gaussian
splatting", 2024) is cut in two along its longest axis (Deng et al., "Efficient density control", 2024). Drawn
by opacity, copies at one place take long to part, and what lies in the dark or behind the sparse points gets
none.

Relocation and growth are pure functions on numpy arrays: one thread, so the results depend on no thread
count. The noise, of every step, is a kernel. A GPU has the same rules, and draws other random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cleargs.random_streams import Stream
from cleargs.splat.backend import backend_for
from cleargs.splat.strategy.base import Strategy

if TYPE_CHECKING:
    from torch import Tensor

    from cleargs.splat.adam import Moments
    from cleargs.splat.config import TrainConfig
    from cleargs.splat.gaussians import Gaussians

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Arrays = dict[str, F32]

MAX_COPIES = 51
"""Most copies that equation 9 is evaluated for, as in gsplat (its sum over binomials loses digits beyond)."""

NOISE_CUT = 0.15
"""Opacity above which the noise factor is under 1e-6, and is left out."""


LOOKS = 5
"""Steps before a refinement whose errors say what is to grow, one frame each. Where refinements follow each
other within eight times as many steps there are fewer, since each costs a backward pass."""

PART = 0.7
"""How far the halves of a Gaussian lie from its middle, and their scale, as shares of its scale along its
longest axis: together they spread about as far (0.7² + 0.7² = 0.98)."""


class MCMC(Strategy):
    """See the module. It remembers the errors since the last refinement."""

    def __init__(self, config: TrainConfig, budget: int, seed: Sequence[int]) -> None:
        self._config = config
        self._budget = budget
        self._seed = tuple(seed)
        self._errors: Tensor | None = None  # [N]

    def wants_errors(self, gaussians: Gaussians, step: int) -> bool:
        """In the last steps up to a refinement at which there is room to grow."""
        config = self._config
        interval = config.refine_interval
        refined = -(-step // interval) * interval
        return (
            gaussians.num < self._budget
            and refined - step < min(LOOKS, max(1, interval // 8))
            and config.refine_start * config.length <= refined <= config.refine_stop * config.length
        )

    def add_errors(self, errors: Tensor) -> None:
        """Summed over the steps."""
        self._errors = errors.clone() if self._errors is None else self._errors + errors

    def refine(self, gaussians: Gaussians, moments: Moments, step: int) -> tuple[Gaussians, Moments]:
        """Relocate the dead and grow."""
        errors, self._errors = self._errors, None
        return backend_for(gaussians.device).relocate_and_grow(
            gaussians,
            moments,
            errors=errors,
            rate=self._config.growth,
            budget=self._budget,
            min_opacity=self._config.min_opacity,
            seed=(*self._seed, Stream.REFINEMENT, step),
        )

    def after_step(self, gaussians: Gaussians, rate: float, step: int) -> None:
        """Add the noise of a step to the means."""
        config = self._config
        if config.noise > 0.0:
            backend_for(gaussians.device).add_position_noise(
                gaussians,
                amount=config.noise * rate,
                min_opacity=config.min_opacity,
                seed=(*self._seed, Stream.POSITION_NOISE, step),
            )

    def state(self) -> dict[str, Tensor]:
        """The errors since the last refinement."""
        return {} if self._errors is None else {"errors": self._errors}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Resume from what `state` gave."""
        self._errors = state.get("errors")


def sample(weights: F64, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``count`` indices with replacement, in proportion to ``weights`` [N] >= 0 (sum > 0)."""
    cumulative = np.cumsum(weights, dtype=np.float64)
    drawn = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right")
    indices: NDArray[np.int64] = np.minimum(drawn, len(weights) - 1)
    return indices


def split_opacity(opacity: F64, copies: NDArray[np.int64]) -> tuple[F64, F64]:
    """Opacity and scale factor with which ``copies`` [M] Gaussians at one place look like the one before.

    Equation 9 of the paper: (opacities [M], factors on the scales [M]) from ``opacity`` [M] in (0, 1).
    """
    copies = np.minimum(copies, MAX_COPIES)
    split = 1.0 - (1.0 - opacity) ** (1.0 / copies)
    denominator = np.zeros_like(split)
    for i in range(1, int(copies.max(initial=0)) + 1):
        terms = sum(
            math.comb(i - 1, k) * (-1.0) ** k / math.sqrt(k + 1.0) * split ** (k + 1) for k in range(i)
        )
        denominator += np.where(i <= copies, terms, 0.0)
    return split, opacity / denominator


def relocate(
    arrays: Arrays, moments: Sequence[Arrays], *, min_opacity: float, rng: np.random.Generator
) -> int:
    """Move dead Gaussians onto live ones drawn by opacity, in place; returns how many moved.

    ``arrays`` are the parameters by name (first axis N), ``moments`` the optimiser's running means, which
    become 0 for every Gaussian that changed.
    """
    opacity = sigmoid(arrays["logit_opacities"].astype(np.float64))
    dead = np.flatnonzero(~(opacity > min_opacity))
    alive = np.flatnonzero(opacity > min_opacity)
    if not len(dead) or not len(alive):
        return 0
    sources = alive[sample(opacity[alive], len(dead), rng)]
    changed = _split(arrays, sources, min_opacity)
    for array in arrays.values():
        array[dead] = array[sources]
    for moment in moments:
        for array in moment.values():
            array[changed] = 0
            array[dead] = 0
    return len(dead)


def grow(
    arrays: Arrays,
    moments: Sequence[Arrays],
    *,
    errors: F64 | None,  # [N] >= 0
    rate: float,
    budget: int,
    min_opacity: float,
    rng: np.random.Generator,
) -> tuple[Arrays, list[Arrays]]:
    """Cut Gaussians in two, drawn in proportion to ``errors`` (None: to their opacities): at most a share
    ``rate``, never beyond ``budget``.

    Returns new arrays and moments. ``arrays`` and ``moments`` as in `relocate`; those given are changed and
    must not be used again. The moments of both halves are 0.
    """
    opacity = sigmoid(arrays["logit_opacities"].astype(np.float64))
    weights = np.where(opacity > min_opacity, opacity if errors is None else errors, 0.0)
    count = len(opacity)
    extra = min(min(budget, int((1.0 + rate) * count)) - count, int((weights > 0.0).sum()))
    if extra <= 0:
        return arrays, list(moments)
    cut = sample_once(weights, extra, rng)
    others = _halves(arrays, cut, opacity[cut], min_opacity)
    grown = {name: np.concatenate([array, others[name]]) for name, array in arrays.items()}
    reset_moments = []
    for moment in moments:
        for array in moment.values():
            array[cut] = 0
        reset_moments.append(
            {
                name: np.concatenate([array, np.zeros((extra, *array.shape[1:]), array.dtype)])
                for name, array in moment.items()
            }
        )
    return grown, reset_moments


def sample_once(weights: F64, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``count`` different indices, in proportion to ``weights`` [N] >= 0, of which as many are above 0.

    Efraimidis and Spirakis, "Weighted random sampling with a reservoir" (2006).
    """
    with np.errstate(divide="ignore"):
        keys = rng.standard_exponential(len(weights)) / weights
    first: NDArray[np.int64] = np.argsort(keys, kind="stable")[:count]
    return first


def _halves(arrays: Arrays, cut: NDArray[np.int64], opacity: F64, min_opacity: float) -> Arrays:
    """Make the Gaussians ``cut`` one of their halves, in place, and return the other ones.

    The opacity is such that the optical depth, summed along the axis, stays.
    """
    longest = arrays["log_scales"][cut].argmax(axis=1)
    axes = rotation_matrices(arrays["rotations"][cut])[np.arange(len(cut)), :, longest]
    away = axes * (PART * np.exp(arrays["log_scales"][cut, longest]))[:, None]
    faint = np.clip(1.0 - (1.0 - opacity) ** (0.5 / PART), min_opacity, 1.0 - 1e-6)
    arrays["log_scales"][cut, longest] += np.float32(math.log(PART))
    arrays["logit_opacities"][cut] = np.log(faint) - np.log1p(-faint)
    others = {name: array[cut] for name, array in arrays.items()}
    arrays["means"][cut] -= away
    others["means"] += away
    return others


def _split(arrays: Arrays, sources: NDArray[np.int64], min_opacity: float) -> NDArray[np.int64]:
    """Give every Gaussian that ``sources`` names, once a copy, its share of opacity and scale, in place.

    Returns their indices without repetition.
    """
    unique, counts = np.unique(sources, return_counts=True)
    opacity = sigmoid(arrays["logit_opacities"][unique].astype(np.float64))
    split, factor = split_opacity(opacity, counts + 1)
    split = np.clip(split, min_opacity, 1.0 - 1e-7)
    arrays["log_scales"][unique] += np.log(factor)[:, None].astype(np.float32)
    arrays["logit_opacities"][unique] = np.log(split) - np.log1p(-split)
    return unique


def rotation_matrices(quaternions: F32) -> F32:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] (w x y z) of any length; zero: no rotation."""
    norm = np.sqrt((quaternions * quaternions).sum(axis=1, keepdims=True))
    w, x, y, z = (quaternions / np.maximum(norm, np.float32(1e-12))).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def sigmoid(x: NDArray[Any]) -> NDArray[Any]:
    """1 / (1 + exp(-x)), in the type of ``x``; the input is kept within +-80, where exp stays finite."""
    result: NDArray[Any] = 1 / (1 + np.exp(-np.clip(x, -80, 80)))
    return result
