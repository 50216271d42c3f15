"""Refinement and noise of 3DGS-MCMC on the GPU, by the rules of ``cleargs.splat.densification``.

Random numbers depend on the step's seed only: those of a refinement come from torch's generator, those of the
noise from Philox in the kernel.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from cleargs.splat import densification
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cuda import device_layout
from cleargs.splat.kernels.cuda.device_layout import PROJECT_BLOCK
from cleargs.splat.kernels.cuda.gradients import store_triple
from cleargs.splat.kernels.cuda.projection import combine, dot, load_triple, rotation_columns, unit_quaternion
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


@triton.jit(do_not_specialize=["seed", "n"])
def add_noise(means, log_scales, rotations, logits, seed, amount, min_opacity, cut, n):
    """Add ``amount`` times the covariance times a normal vector to the means [N, 3].

    Philox draws the vector of each Gaussian from ``seed`` and its number. The noise fades out above
    ``min_opacity``. Gaussians with an opacity of ``cut`` or more get none.
    """
    g = tl.program_id(0) * device_layout.PROJECT_BLOCK + tl.arange(0, device_layout.PROJECT_BLOCK)
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logits + g, mask=g < n, other=0.0).to(tl.float64)))
    some = (g < n) & (opacity < cut)
    fade = amount / (1.0 + tl.exp(100.0 * (opacity - min_opacity)))
    columns = rotation_columns(unit_quaternion(rotations, g, some))
    scales = load_triple(log_scales + g * 3, some)
    draw0, draw1, draw2, _ = tl.randn4x(seed, g)
    draw = (draw0.to(tl.float64), draw1.to(tl.float64), draw2.to(tl.float64))
    part0 = fade * tl.exp(2.0 * scales[0]) * dot(columns[0], draw)
    part1 = fade * tl.exp(2.0 * scales[1]) * dot(columns[1], draw)
    part2 = fade * tl.exp(2.0 * scales[2]) * dot(columns[2], draw)
    mean = load_triple(means + g * 3, some)
    moved = combine(part0, columns[0], part1, columns[1])
    moved = combine(1.0, moved, part2, columns[2])
    moved = combine(1.0, moved, 1.0, mean)
    store_triple(means + g * 3, moved, some)


def add_position_noise(
    gaussians: Gaussians, *, amount: float, min_opacity: float, seed: Sequence[int]
) -> None:
    """Add the noise of one step to the means of Gaussians below ``densification.NOISE_CUT``, in place."""
    parameters = (gaussians.means, gaussians.log_scales, gaussians.rotations, gaussians.logit_opacities)
    if gaussians.num:
        add_noise[(-(-gaussians.num // PROJECT_BLOCK),)](
            *(*parameters, seed_of(seed), amount, min_opacity, densification.NOISE_CUT, gaussians.num),
            num_warps=4,
        )
