"""Refinement and noise of 3DGS-MCMC on the GPU, by the rules of ``cleargs.splat.densification``.

Random numbers come from torch's generator with the step's seed: one device draws the same numbers each time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from cleargs.splat import densification
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.transforms import rotation_matrices
from cleargs.splat.types import Moments


def seed_of(numbers: Sequence[int]) -> int:
    """Return a 63-bit seed that depends on ``numbers`` only."""
    return int(np.random.SeedSequence([*numbers]).generate_state(1, np.uint64)[0] >> 1)


def refine(
    gaussians: Gaussians,
    moments: Moments,
    *,
    errors: Tensor,  # [N] >= 0
    rate: float,
    budget: int,
    min_opacity: float,
    seed: Sequence[int],
) -> tuple[Gaussians, Moments]:
    """See ``densification.refine``. The arguments are changed: do not use them again."""
    running = [moments.first, moments.second]
    generator = torch.Generator(gaussians.device).manual_seed(seed_of(seed))
    errors, start = errors.double(), gaussians.num
    growth = max(0, min(budget, int((1.0 + rate) * start)) - start)
    for done in range(1, densification.ROUNDS + 1):
        opacity = gaussians.logit_opacities.double().sigmoid()
        alive = opacity > min_opacity
        weights, dead = torch.where(alive, errors, 0.0), torch.nonzero(~alive).squeeze(1)
        count = gaussians.num
        room = max(0, start + growth * done // densification.ROUNDS - count)
        cut = sample_once(weights, min(len(dead) + room, int((weights > 0.0).sum())), generator)
        others = _halves(gaussians, cut, opacity[cut], min_opacity)
        errors = torch.cat([errors, errors.new_zeros(max(0, len(cut) - len(dead)))])
        new = torch.arange(count, len(errors), device=dead.device)
        places = torch.cat([dead, new])[: len(cut)]
        errors[cut] /= 2
        errors[places] = errors[cut]
        gaussians = Gaussians(
            **{name: _placed(tensor, places, others[name]) for name, tensor in gaussians.tensors().items()}
        )
        for moment in running:
            for tensor in moment.values():
                tensor[cut] = 0
        running = [
            {name: _placed(tensor, places, torch.zeros_like(others[name])) for name, tensor in moment.items()}
            for moment in running
        ]
    return gaussians, Moments(*running)


def _placed(tensor: Tensor, places: Tensor, rows: Tensor) -> Tensor:
    """See ``densification._placed``."""
    longer = max(len(tensor), 1 + int(places.max())) if len(places) else len(tensor)
    if longer > len(tensor):
        tensor = torch.cat([tensor, tensor.new_zeros(longer - len(tensor), *tensor.shape[1:])])
    tensor[places] = rows
    return tensor


def sample_once(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """See ``densification.sample_once``; ``weights`` [N] are float64."""
    draws = torch.rand(len(weights), generator=generator, dtype=torch.float64, device=weights.device)
    return torch.sort(-torch.log1p(-draws) / weights, stable=True).indices[:count]


def _halves(gaussians: Gaussians, cut: Tensor, opacity: Tensor, min_opacity: float) -> dict[str, Tensor]:
    """Make each Gaussian in ``cut`` its first half and return the other halves: ``densification._halves``."""
    rows = torch.arange(len(cut), device=cut.device)
    longest = gaussians.log_scales[cut].argmax(dim=1)
    axes = rotation_matrices(gaussians.rotations[cut])[rows, :, longest]
    away = axes * (densification.SPLIT_FRACTION * gaussians.log_scales[cut, longest].exp())[:, None]
    faint = (1.0 - (1.0 - opacity) ** (0.5 / densification.SPLIT_FRACTION)).clamp(min_opacity, 1.0 - 1e-6)
    gaussians.log_scales[cut, longest] += math.log(densification.SPLIT_FRACTION)
    gaussians.logit_opacities[cut] = (faint.log() - torch.log1p(-faint)).float()
    others = {name: tensor[cut] for name, tensor in gaussians.tensors().items()}
    gaussians.means[cut] -= away
    others["means"] += away
    return others


def add_position_noise(
    gaussians: Gaussians, *, amount: float, min_opacity: float, seed: Sequence[int]
) -> None:
    """Add the noise of one step to the means of Gaussians below ``densification.NOISE_CUT``, in place."""
    generator = torch.Generator(gaussians.device).manual_seed(seed_of(seed))
    opacity = gaussians.logit_opacities.sigmoid()
    fade = amount / (1.0 + (100.0 * (opacity - min_opacity)).exp())
    fade = torch.where(opacity < densification.NOISE_CUT, fade, 0.0)
    axes = rotation_matrices(gaussians.rotations)
    draw = torch.randn(gaussians.num, 3, generator=generator, device=gaussians.device)
    local = (axes * draw[:, :, None]).sum(dim=1) * (2.0 * gaussians.log_scales).exp()  # S² Rᵀ draw
    gaussians.means += fade[:, None] * (axes * local[:, None, :]).sum(dim=2)
