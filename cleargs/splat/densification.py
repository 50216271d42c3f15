"""Densification after "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand et al. 2024).

As there, dead Gaussians move, the number grows to a hard budget, and noise that only transparent Gaussians
feel is added to the means. But the error says where, not opacity: what takes part in pixels that are far from
their frames (Rota Bulò et al., "Revising densification in Gaussian splatting", 2024) is cut in two along its
longest axis (Deng et al., "Efficient density control", 2024); the dead become halves, as the new ones are.
Drawn by opacity, copies at one place take long to part, and what lies in the dark or behind the sparse points
gets none.

Here are the rules of a refinement: pure functions on numpy arrays, on one thread, so that the results depend
on no thread count. The noise, of every step, is a kernel. A GPU has the same rules, and draws other random
numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cleargs.types import AnyArray, ArrayF32, ArrayF64

Arrays = dict[str, ArrayF32]

NOISE_CUT = 0.15
"""Opacity above which the noise factor is under 1e-6, and is left out."""

ROUNDS = 4
"""Rounds of a refinement, each with its share of the growth: a Gaussian with much of the error, such as a
smear over half of a frame, is cut into up to sixteen."""

SPLIT_FRACTION = 0.7
"""How far the halves of a Gaussian lie from its middle, and their scale, as shares of its scale along its
longest axis: together they spread about as far (0.7² + 0.7² = 0.98)."""


def refine(
    arrays: Arrays,
    moments: Sequence[Arrays],
    *,
    errors: ArrayF64,  # [N] >= 0
    rate: float,
    budget: int,
    min_opacity: float,
    rng: np.random.Generator,
) -> tuple[Arrays, list[Arrays]]:
    """Cut live Gaussians in two, drawn in proportion to ``errors``, in `ROUNDS` rounds. The other halves take
    the places of the dead, and new ones: at most a share ``rate``, never beyond ``budget``.

    ``arrays`` are the parameters by name (first axis N), ``moments`` the optimiser's running means, which
    become 0 for both halves. Returns new ones; those given are changed and must not be used again.
    """
    running, start = list(moments), len(errors)
    growth = max(0, min(budget, int((1.0 + rate) * start)) - start)
    for done in range(1, ROUNDS + 1):
        opacity = sigmoid(arrays["logit_opacities"].astype(np.float64))
        alive = opacity > min_opacity  # not so is NaN
        weights, dead = np.where(alive, errors, 0.0), np.flatnonzero(~alive)
        count = len(opacity)
        room = max(0, start + growth * done // ROUNDS - count)
        cut = sample_once(weights, min(len(dead) + room, int((weights > 0.0).sum())), rng)
        others = _halves(arrays, cut, opacity[cut], min_opacity)
        errors = np.concatenate([errors, np.zeros(max(0, len(cut) - len(dead)))])
        places = np.concatenate([dead, np.arange(count, len(errors))])[: len(cut)]
        errors[cut] /= 2
        errors[places] = errors[cut]
        arrays = {name: _placed(array, places, others[name]) for name, array in arrays.items()}
        for moment in running:
            for array in moment.values():
                array[cut] = 0
        running = [
            {name: _placed(array, places, np.zeros_like(others[name])) for name, array in moment.items()}
            for moment in running
        ]
    return arrays, running


def _placed(array: ArrayF32, places: NDArray[np.int64], rows: ArrayF32) -> ArrayF32:
    """``array`` with ``rows`` at ``places``, made longer where these lie behind its end."""
    longer = max(len(array), 1 + int(places.max(initial=-1)))
    if longer > len(array):
        array = np.concatenate([array, np.zeros((longer - len(array), *array.shape[1:]), array.dtype)])
    array[places] = rows
    return array


def sample_once(weights: ArrayF64, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """``count`` different indices, in proportion to ``weights`` [N] >= 0, of which as many are above 0.

    Efraimidis and Spirakis, "Weighted random sampling with a reservoir" (2006).
    """
    with np.errstate(divide="ignore"):
        keys = rng.standard_exponential(len(weights)) / weights
    first: NDArray[np.int64] = np.argsort(keys, kind="stable")[:count]
    return first


def _halves(arrays: Arrays, cut: NDArray[np.int64], opacity: ArrayF64, min_opacity: float) -> Arrays:
    """Make the Gaussians ``cut`` one of their halves, in place, and return the other ones.

    The opacity is such that the optical depth, summed along the axis, stays.
    """
    longest = arrays["log_scales"][cut].argmax(axis=1)
    axes = rotation_matrices(arrays["rotations"][cut])[np.arange(len(cut)), :, longest]
    away = axes * (SPLIT_FRACTION * np.exp(arrays["log_scales"][cut, longest]))[:, None]
    faint = np.clip(1.0 - (1.0 - opacity) ** (0.5 / SPLIT_FRACTION), min_opacity, 1.0 - 1e-6)
    arrays["log_scales"][cut, longest] += np.float32(math.log(SPLIT_FRACTION))
    arrays["logit_opacities"][cut] = np.log(faint) - np.log1p(-faint)
    others = {name: array[cut] for name, array in arrays.items()}
    arrays["means"][cut] -= away
    others["means"] += away
    return others


def rotation_matrices(quaternions: ArrayF32) -> ArrayF32:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] (w x y z) of any length; zero: no rotation."""
    norm = np.sqrt((quaternions * quaternions).sum(axis=1, keepdims=True))
    w, x, y, z = (quaternions / np.maximum(norm, np.float32(1e-12))).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def sigmoid(x: AnyArray) -> AnyArray:
    """1 / (1 + exp(-x)), in the type of ``x``; the input is kept within +-80, where exp stays finite."""
    result: AnyArray = 1 / (1 + np.exp(-np.clip(x, -80, 80)))
    return result
