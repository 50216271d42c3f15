"""Densification based on "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand et al. 2024).

As in that paper, dead Gaussians are relocated, the number of Gaussians grows to a hard budget, and each step
adds noise to the means of transparent Gaussians. Two rules differ:

- Gaussians are drawn by their error, not by their opacity: by their contribution to the error of the frames
  (Rota Bulò et al., "Revising densification in Gaussian splatting", 2024). Draws by opacity add nothing in
  dark regions and behind the sparse points. The error is relative to the contrast of the frame
  (`relative_error`). Otherwise texture of low contrast would get few Gaussians.
- A drawn Gaussian is split along its longest axis (Deng et al., "Efficient density control", 2024). Two
  copies at the same place would need many steps to separate.

`refine` works on numpy arrays (on one thread, so that results do not depend on the number of threads) or on
tensors of a GPU: ``xp`` is the module numpy or torch, whose functions have the same names here. A kernel adds
the noise (`Backend.add_position_noise`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from cleargs.types import AnyArray

Arrays = dict[str, Any]
"""Arrays or tensors by name, float32, first axis N."""


class RandomSource(Protocol):
    """Source of random numbers, such as `numpy.random.Generator`."""

    def standard_exponential(self, size: int, /) -> Any: ...


NOISE_CUT = 0.15
"""Opacity above which the noise is skipped: its factor is below 1e-6."""

ROUNDS = 4
"""Number of rounds per refinement, each with an equal part of the growth. A Gaussian with a large error, such
as a smear over half of a frame, is split into up to 16."""

SPLIT_FRACTION = 0.7
"""Offset of the two halves from the centre, and their scale, relative to the scale of the split Gaussian
along its longest axis. The variance is almost preserved: 0.7² + 0.7² = 0.98."""

CONTRAST_WINDOW = 11
"""Width of the square window in which the contrast of a frame is measured, pixels."""
CONTRAST_FLOOR = 0.002
"""Variance that is added to that of the window. It corresponds to a deviation of 11 of 255."""


def relative_error(
    image: Tensor,  # [H, W, 3] sRGB
    target: Tensor,  # [H, W, 3] sRGB
    mask: Tensor | None,  # [H, W] bool, True = counts
) -> Tensor:
    """Return squared errors over the variance of ``target`` around each pixel, [H, W, 3] >= 0.

    The variance is the mean over the three channels, plus `CONTRAST_FLOOR`. Masked pixels have the error 0
    and do not count in the variances of others. Results do not depend on the number of threads.
    """
    counted = torch.ones_like(target[..., :1]) if mask is None else mask[..., None].to(target.dtype)
    values = torch.cat([target, target.square().mean(dim=-1, keepdim=True), counted], dim=-1)
    sums = (values * counted).permute(2, 0, 1)
    for size in ((CONTRAST_WINDOW, 1), (1, CONTRAST_WINDOW)):
        sums = avg_pool2d(sums, size, stride=1, padding=(size[0] // 2, size[1] // 2))
    means = sums[:4] / sums[4].clamp(min=1e-3)
    variance = (means[3] - means[:3].square().mean(dim=0)).clamp_(min=0.0)
    return (image - target).square_().mul_(counted) / (variance + CONTRAST_FLOOR)[..., None]


def refine(
    arrays: Arrays,  # parameters; they are changed and must not be used again
    moments: Sequence[Arrays],  # running means of Adam, also changed; 0 for both halves after a split
    *,
    errors: Any,  # [N] float64 >= 0
    rate: float,  # maximum growth, as a fraction of N
    budget: int,  # maximum number of Gaussians after the growth
    min_opacity: float,  # opacity up to which a Gaussian is dead
    rng: RandomSource,
    xp: Any = np,  # module of the arrays, numpy or torch
) -> tuple[Arrays, list[Arrays]]:
    """Split live Gaussians, drawn in proportion to their errors, in `ROUNDS` rounds.

    The first half stays in place. The second half replaces a dead Gaussian, or is appended. Returns the
    new parameters and moments.
    """
    running, start = list(moments), len(errors)
    growth = max(0, min(budget, int((1.0 + rate) * start)) - start)
    for done in range(1, ROUNDS + 1):
        opacity = sigmoid(xp.asarray(arrays["logit_opacities"], dtype=xp.float64), xp)
        alive = opacity > min_opacity  # False for NaN
        weights, dead = xp.where(alive, errors, 0.0), xp.where(~alive)[0]
        count = len(opacity)
        room = max(0, start + growth * done // ROUNDS - count)
        chosen = sample_once(weights, min(len(dead) + room, int((weights > 0.0).sum())), rng, xp)
        others = _split(arrays, chosen, opacity[chosen], min_opacity, xp)
        errors = xp.concatenate([errors, xp.zeros_like(errors[: max(0, len(chosen) - len(dead))])])
        new = xp.arange(count, len(errors), device=errors.device)
        places = xp.concatenate([dead, new])[: len(chosen)]
        errors[chosen] /= 2
        errors[places] = errors[chosen]
        arrays = {name: _write_rows(array, places, others[name], xp) for name, array in arrays.items()}
        for moment in running:
            for array in moment.values():
                array[chosen] = 0
        running = [
            {
                name: _write_rows(array, places, xp.zeros_like(others[name]), xp)
                for name, array in moment.items()
            }
            for moment in running
        ]
    return arrays, running


def _write_rows(array: Any, places: Any, rows: Any, xp: Any) -> Any:
    """Write ``rows`` at ``places`` of ``array``, extended if places are beyond its end."""
    missing = 1 + int(places.max()) - len(array) if len(places) else 0
    if missing > 0:
        array = xp.concatenate([array, xp.zeros_like(array[:missing])])
    array[places] = rows
    return array


def sample_once(
    weights: Any, count: int, rng: RandomSource, xp: Any = np
) -> Any:  # [N] float64 -> [count] int64
    """Draw indices without replacement, in proportion to ``weights`` [N] >= 0.

    At least ``count`` weights must be positive. Source: Efraimidis and Spirakis, "Weighted random sampling
    with a reservoir" (2006).
    """
    with np.errstate(divide="ignore"):
        keys = rng.standard_exponential(len(weights)) / weights
    return xp.argsort(keys, stable=True)[:count]


def _split(arrays: Arrays, chosen: Any, opacity: Any, min_opacity: float, xp: Any) -> Arrays:
    """Replace the Gaussians ``chosen`` by their first halves in place, and return the second halves.

    The opacity of the halves preserves the optical depth, summed along the axis.
    """
    longest = arrays["log_scales"][chosen].argmax(axis=1)
    axes = rotation_matrices(arrays["rotations"][chosen], xp)
    axes = axes[xp.arange(len(chosen), device=chosen.device), :, longest]
    away = axes * (SPLIT_FRACTION * xp.exp(arrays["log_scales"][chosen, longest]))[:, None]
    faint = xp.clip(1.0 - (1.0 - opacity) ** (0.5 / SPLIT_FRACTION), min_opacity, 1.0 - 1e-6)
    arrays["log_scales"][chosen, longest] += math.log(SPLIT_FRACTION)
    arrays["logit_opacities"][chosen] = xp.asarray(xp.log(faint) - xp.log1p(-faint), dtype=xp.float32)
    others = {name: array[chosen] for name, array in arrays.items()}
    arrays["means"][chosen] -= away
    others["means"] += away
    return others


def rotation_matrices(quaternions: Any, xp: Any = np) -> Any:
    """Return the rotation matrices [N, 3, 3] of quaternions w x y z [N, 4] of any norm (zero: identity)."""
    norm = xp.sqrt((quaternions * quaternions).sum(axis=1, keepdims=True))
    w, x, y, z = (quaternions / xp.clip(norm, 1e-12, None)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, axis=1) for row in rows], axis=1)


def sigmoid(x: AnyArray, xp: Any = np) -> AnyArray:
    """Return 1 / (1 + exp(-x)) in the type of ``x``, which is clamped to +-80 so that exp stays finite."""
    result: AnyArray = 1 / (1 + xp.exp(-xp.clip(x, -80, 80)))
    return result
