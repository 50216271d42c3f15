"""Refinement and noise of 3DGS-MCMC on the GPU, by the rules of ``cleargs.splat.densification``.

Random numbers come from torch's generator with the step's seed: one device draws the same numbers each time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from cleargs.splat import densification
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.types import Moments


def seed_of(numbers: Sequence[int]) -> int:
    """Return a 63-bit seed that depends on ``numbers`` only."""
    return int(np.random.SeedSequence([*numbers]).generate_state(1, np.uint64)[0] >> 1)


class _Draws:
    """Random numbers of the GPU for `densification.refine`."""

    def __init__(self, device: torch.device, seed: Sequence[int]) -> None:
        self._generator = torch.Generator(device).manual_seed(seed_of(seed))

    def standard_exponential(self, size: int) -> Tensor:
        draws = torch.rand(
            size, generator=self._generator, dtype=torch.float64, device=self._generator.device
        )
        return -torch.log1p(-draws)


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
    grown, running = densification.refine(
        gaussians.tensors(),
        [moments.first, moments.second],
        errors=errors.double(),
        rate=rate,
        budget=budget,
        min_opacity=min_opacity,
        rng=_Draws(gaussians.device, seed),
        xp=torch,
    )
    return Gaussians(**grown), Moments(*running)


def add_position_noise(
    gaussians: Gaussians, *, amount: float, min_opacity: float, seed: Sequence[int]
) -> None:
    """Add the noise of one step to the means of Gaussians below ``densification.NOISE_CUT``, in place."""
    generator = torch.Generator(gaussians.device).manual_seed(seed_of(seed))
    opacity = gaussians.logit_opacities.sigmoid()
    fade = amount / (1.0 + (100.0 * (opacity - min_opacity)).exp())
    fade = torch.where(opacity < densification.NOISE_CUT, fade, 0.0)
    axes = densification.rotation_matrices(gaussians.rotations, torch)
    draw = torch.randn(gaussians.num, 3, generator=generator, device=gaussians.device)
    local = (axes * draw[:, :, None]).sum(dim=1) * (2.0 * gaussians.log_scales).exp()  # S² Rᵀ draw
    gaussians.means += fade[:, None] * (axes * local[:, None, :]).sum(dim=2)
