"""Relocation, growth and noise of 3DGS-MCMC on the device; the rules are those of ``strategy.mcmc``.

Relocation and growth happen every so many steps and are torch operations; the noise of every step is one
kernel. Draws come from Philox counters keyed by the step's seed. Gaussians are drawn through integer prefix
sums, whose order of addition does not matter: the same device draws the same Gaussians each time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cuda.projection import dot, rotation_columns
from cleargs.splat.kernels.reference import rotation_matrices
from cleargs.splat.strategy import mcmc

BLOCK = 256
WEIGHT_BITS = 32
"""Opacities are drawn from in units of 2^-32; twenty million of them stay below 2^63."""


def seed_of(*numbers: int) -> int:
    """A 63-bit seed from a tuple of numbers, stateless as NumPy's."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> 1)


def generator_of(seed: int, device: torch.device) -> torch.Generator:
    """torch's generator on ``device`` in the state that ``seed`` names."""
    return torch.Generator(device).manual_seed(seed)


def sample(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """``count`` indices with replacement, in proportion to ``weights`` [N] in [0, 1], not all 0."""
    cumulative = (weights.double() * 2.0**WEIGHT_BITS).long().cumsum(0)
    draws = torch.rand(count, generator=generator, dtype=torch.float64, device=weights.device)
    return torch.searchsorted(cumulative, (draws * cumulative[-1]).long(), right=True).clamp_max(
        len(weights) - 1
    )


def split_opacity(opacity: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """``mcmc.split_opacity`` on float64 tensors [M].

    The double sum of the paper's equation 9 is one sum here, as C(0, k) + ... + C(c - 1, k) = C(c, k + 1).
    """
    most = mcmc.MAX_COPIES
    table = torch.tensor(
        [
            [(-1.0) ** k / math.sqrt(k + 1.0) * math.comb(c, k + 1) for k in range(most)]
            for c in range(most + 1)
        ],
        dtype=torch.float64,
        device=opacity.device,
    )
    copies = copies.clamp_max(most)
    split = 1.0 - (1.0 - opacity) ** (1.0 / copies.double())
    denominator = torch.zeros_like(split)
    power = split.clone()
    for k in range(most):
        denominator += table[copies, k] * power
        power *= split
    return split, opacity / denominator


def relocate(
    gaussians: Gaussians, moments: Sequence[dict[str, Tensor]], *, min_opacity: float, seed: int
) -> int:
    """Move dead Gaussians onto live ones drawn by opacity, in place; returns how many moved.

    ``moments`` are the optimiser's running means by parameter; those of every Gaussian that changed become 0.
    """
    opacity = gaussians.logit_opacities.double().sigmoid()
    alive = opacity > min_opacity
    dead = torch.nonzero(~alive).squeeze(1)
    if len(dead) in (0, gaussians.num):
        return 0
    generator = generator_of(seed, gaussians.device)
    sources = sample(torch.where(alive, opacity, 0.0), len(dead), generator)
    changed = _split(gaussians, sources, min_opacity)
    for tensor in gaussians.tensors().values():
        tensor[dead] = tensor[sources]
    for moment in moments:
        for tensor in moment.values():
            tensor[changed] = 0
            tensor[dead] = 0
    return len(dead)


def grow(
    gaussians: Gaussians,
    moments: Sequence[dict[str, Tensor]],
    *,
    errors: Tensor | None,  # [N] >= 0
    rate: float,
    budget: int,
    min_opacity: float,
    seed: int,
) -> tuple[Gaussians, list[dict[str, Tensor]]]:
    """Cut Gaussians in two, drawn in proportion to ``errors`` (None: to their opacities): at most a share
    ``rate``, never beyond ``budget``.

    Returns new Gaussians and moments; those given are changed and must not be used again.
    """
    opacity = gaussians.logit_opacities.double().sigmoid()
    weights = torch.where(opacity > min_opacity, opacity if errors is None else errors.double(), 0.0)
    count = gaussians.num
    extra = min(min(budget, int((1.0 + rate) * count)) - count, int((weights > 0.0).sum()))
    if extra <= 0:
        return gaussians, list(moments)
    cut = sample_once(weights, extra, generator_of(seed, gaussians.device))
    others = _halves(gaussians, cut, opacity[cut], min_opacity)
    grown = Gaussians(
        **{name: torch.cat([tensor, others[name]]) for name, tensor in gaussians.tensors().items()}
    )
    reset_moments = []
    for moment in moments:
        for tensor in moment.values():
            tensor[cut] = 0
        reset_moments.append(
            {
                name: torch.cat([tensor, tensor.new_zeros(extra, *tensor.shape[1:])])
                for name, tensor in moment.items()
            }
        )
    return grown, reset_moments


def sample_once(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """``mcmc.sample_once`` of float64 ``weights`` [N]."""
    draws = torch.rand(len(weights), generator=generator, dtype=torch.float64, device=weights.device)
    return torch.sort(-torch.log1p(-draws) / weights, stable=True).indices[:count]


def _halves(gaussians: Gaussians, cut: Tensor, opacity: Tensor, min_opacity: float) -> dict[str, Tensor]:
    """``mcmc._halves``: make the Gaussians ``cut`` one of their halves, and return the other ones."""
    rows = torch.arange(len(cut), device=cut.device)
    longest = gaussians.log_scales[cut].argmax(dim=1)
    axes = rotation_matrices(gaussians.rotations[cut])[rows, :, longest]
    away = axes * (mcmc.PART * gaussians.log_scales[cut, longest].exp())[:, None]
    faint = (1.0 - (1.0 - opacity) ** (0.5 / mcmc.PART)).clamp(min_opacity, 1.0 - 1e-6)
    gaussians.log_scales[cut, longest] += math.log(mcmc.PART)
    gaussians.logit_opacities[cut] = (faint.log() - torch.log1p(-faint)).float()
    others = {name: tensor[cut] for name, tensor in gaussians.tensors().items()}
    gaussians.means[cut] -= away
    others["means"] += away
    return others


def _split(gaussians: Gaussians, sources: Tensor, min_opacity: float) -> Tensor:
    """Give every Gaussian that ``sources`` names, once a copy, its share of opacity and scale, in place.

    Returns their indices without repetition.
    """
    counts = torch.zeros(gaussians.num, dtype=torch.int64, device=gaussians.device)
    counts.scatter_add_(0, sources, torch.ones_like(sources))
    unique = torch.nonzero(counts).squeeze(1)
    opacity = gaussians.logit_opacities[unique].double().sigmoid()
    split, factor = split_opacity(opacity, counts[unique] + 1)
    split = split.clamp(min_opacity, 1.0 - 1e-7)
    gaussians.log_scales[unique] += factor.log().float()[:, None]
    gaussians.logit_opacities[unique] = (split.log() - torch.log1p(-split)).float()
    return unique


@triton.jit(do_not_specialize=["n", "seed"])
def position_noise_kernel(
    means, log_scales, rotations, logits, n, seed, amount, min_opacity, cut, BLOCK: tl.constexpr
):
    """Add ``amount`` covariance times a normal draw to the means, faded out around ``min_opacity``."""
    g = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = g < n
    opacity = 1.0 / (1.0 + tl.exp(-tl.load(logits + g, mask=mask, other=0.0)))
    felt = mask & (opacity < cut)
    fade = amount / (1.0 + tl.exp(100.0 * (opacity - min_opacity)))
    n0, n1, n2, _ = tl.randn4x(seed, g)
    draw = (n0, n1, n2)
    w = tl.load(rotations + g * 4, mask=felt, other=1.0)
    x = tl.load(rotations + g * 4 + 1, mask=felt, other=0.0)
    y = tl.load(rotations + g * 4 + 2, mask=felt, other=0.0)
    z = tl.load(rotations + g * 4 + 3, mask=felt, other=0.0)
    inverse = 1.0 / tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    columns = rotation_columns((w * inverse, x * inverse, y * inverse, z * inverse))
    # S² Rᵀ draw, in the Gaussian's own axes
    local0 = dot(columns[0], draw) * tl.exp(2.0 * tl.load(log_scales + g * 3, mask=felt, other=0.0))
    local1 = dot(columns[1], draw) * tl.exp(2.0 * tl.load(log_scales + g * 3 + 1, mask=felt, other=0.0))
    local2 = dot(columns[2], draw) * tl.exp(2.0 * tl.load(log_scales + g * 3 + 2, mask=felt, other=0.0))
    for axis in tl.static_range(3):
        offset = columns[0][axis] * local0 + columns[1][axis] * local1 + columns[2][axis] * local2
        value = tl.load(means + g * 3 + axis, mask=felt, other=0.0)
        tl.store(means + g * 3 + axis, value + offset * fade, mask=felt)


def add_position_noise(gaussians: Gaussians, *, amount: float, min_opacity: float, seed: int) -> None:
    """Noise on the means for one step, in place; only Gaussians below ``mcmc.NOISE_CUT`` feel it."""
    position_noise_kernel[(-(-gaussians.num // BLOCK),)](
        gaussians.means,
        gaussians.log_scales,
        gaussians.rotations,
        gaussians.logit_opacities,
        gaussians.num,
        seed,
        amount,
        min_opacity,
        mcmc.NOISE_CUT,
        BLOCK=BLOCK,
        num_warps=4,
    )
