"""Finding what happened while a frame was taken: under which numbers the render looks like the raw frame.

Motions by Levenberg-Marquardt with Huber weights, discs of defocus by a pattern search, both from coarse to
fine.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cleargs.formation.comparison import (
    COARSE,
    DISC,
    LEVELS,
    FramePair,
    Level,
    MotionFit,
    SearchKernels,
    scales,
)
from cleargs.formation.motion import TWIST, FrameMotion, Model
from cleargs.splat.kernels.cpu import backend as cpu
from cleargs.types import ArrayF64

WARM_STEPS = 2
"""Gauss-Newton steps of a fit that starts from the last one."""

LENGTHS = (2.0, 4.0, 7.0, 11.0, 16.0, 22.0, 30.0)
DIRECTIONS = 8
"""The blurs that a search begins with, in pixels of the coarsest level. It only goes downhill, and a long
blur lies behind hills."""
STARTS = 3
"""The best of them are followed, and so is no motion."""

RADII = (1.0, 2.0, 3.0, 4.5, 7.0)
"""Mean radii of the discs that a search for defocus begins with, in pixels of the coarsest level."""
NARROWING = (0.25, 0.12, 0.06)
"""Steps of its pattern search, as shares of the radius and of the range of nearness."""

MODEL_PENALTY = 0.005
"""Share of the misfit that each further motion must explain to be preferred to a simpler model."""

DAMPING, MORE_DAMPING = 1e-2, 6.0
DAMPING_FLOOR = 1e-4
"""Damping of every direction, as a share of the stiffest: what the image does not show stays near zero."""
CONVERGED = 1e-3
MAX_TRIES = 4

POSE, BLUR, SKEW = (slice(k * TWIST, (k + 1) * TWIST) for k in range(3))
_ACTIVE: dict[Model, tuple[slice, ...]] = {"blur": (BLUR,), "skew": (SKEW,), "both": (BLUR, SKEW)}
_PARTS: dict[Model, int] = {"none": 0, "blur": 1, "skew": 1, "both": 2, "defocus": 1}


def search(
    pair: FramePair, *, skew: bool = True, pose: bool = False, kernels: SearchKernels = cpu
) -> list[MotionFit]:
    """Every model at its best, from scratch. The first is ``none``.

    skew: whether models with a rolling shutter are tried too; without them it takes half the time.
    pose: whether a correction of the pose is sought beside each motion.
    kernels: the back end that computes misfits and normal equations.
    """
    levels = [Level(pair, scale, kernels) for scale in scales(pair)]
    coarse = levels[0]
    still = FrameMotion(median_depth=coarse.median)
    models: tuple[Model, ...] = ("both", "blur", "skew") if skew else ("blur",)
    start = _best(coarse, _starts(coarse, still), models[0], LEVELS[0][1], pose)
    found: dict[Model, FrameMotion] = {}
    for model in models:
        motion = _restricted(start, model)
        for level, (_, steps) in zip(levels, LEVELS, strict=False):
            motion = _best(level, [motion, still], model, steps, pose)
        found[model] = motion
    disc = _sharpest_disc(coarse, still)
    for level in levels[1:]:
        disc = _narrowed(level, disc)
    found["defocus"] = disc
    return [levels[-1].evaluate("none", still), *(levels[-1].evaluate(name, found[name]) for name in found)]


def refine(
    pair: FramePair,
    model: Model,
    motion: FrameMotion,
    *,
    pose: bool = False,
    kernels: SearchKernels = cpu,
) -> list[MotionFit]:
    """``model`` again, from the numbers of the last fit, at the finest level; the first is ``none``."""
    level = Level(pair, scales(pair)[-1], kernels)
    still = FrameMotion(median_depth=level.median)
    motion = replace(motion, median_depth=level.median)
    if model == "defocus":
        motion = _narrowed(level, motion)
    elif model != "none":
        motion = _best(level, [motion], model, WARM_STEPS, pose)
    return [level.evaluate("none", still), level.evaluate(model, motion)]


def preferred(found: list[MotionFit]) -> MotionFit:
    """The model with the least misfit on the pixels that judge, simpler ones at a discount."""
    return min(found, key=lambda e: e.misfit * (1.0 + MODEL_PENALTY * _PARTS[e.model]))


def _restricted(motion: FrameMotion, model: Model) -> FrameMotion:
    vector = np.zeros(3 * TWIST)
    for part in (POSE, *_ACTIVE[model]):
        vector[part] = motion.vector[part]
    return motion.with_vector(vector)


def _best(level: Level, starts: list[FrameMotion], model: Model, steps: int, pose: bool) -> FrameMotion:
    """The best end of the descents from ``starts``."""
    parts = (POSE, *_ACTIVE[model]) if pose else _ACTIVE[model]
    active = np.concatenate([np.arange(3 * TWIST)[part] for part in parts])
    ends = [_descend(level, start, active, steps) for start in starts]
    return min(ends, key=level.cost)


def _starts(level: Level, still: FrameMotion) -> list[FrameMotion]:
    """The most promising of the rotations about the axes across the view, and none."""
    pixel = 1.0 / level.scale
    motions = [
        replace(still, blur=_rotation(length * pixel, math.pi * k / DIRECTIONS))
        for length in LENGTHS
        for k in range(DIRECTIONS)
    ]
    costs = [level.cost(motion, COARSE) for motion in motions]
    first = [motions[k] for k in np.argsort(costs, kind="stable")[:STARTS]]
    # Short: at none the slope by the blur vanishes, and the descent would stay there.
    return [*first, replace(still, blur=_rotation(0.5 * pixel, 0.0)), still]


def _sharpest_disc(level: Level, still: FrameMotion) -> FrameMotion:
    """The best of a grid of discs."""
    low, middle, high = (float(q) for q in np.quantile(level.nearness, (0.05, 0.5, 0.95)))
    discs = []
    for focus in (0.0, low, middle, high, 2.0 * high):
        spread = float(np.abs(level.nearness - np.float32(focus)).mean(dtype=np.float64))
        for radius in RADII:
            discs.append(replace(still, disc_px=radius / level.scale / max(spread, 1e-3), focus=focus))
    return min(discs, key=lambda disc: level.cost(disc, DISC))


def _narrowed(level: Level, disc: FrameMotion) -> FrameMotion:
    """The end of a pattern search around ``disc``."""
    best, cost = disc, level.cost(disc, DISC)
    span = float(np.ptp(np.quantile(level.nearness, (0.05, 0.95)))) + 0.1
    for step in NARROWING:
        for radius, focus in (
            (1 + step, 0.0),
            (1 / (1 + step), 0.0),
            (1.0, step * span),
            (1.0, -step * span),
        ):
            tried = replace(best, disc_px=best.disc_px * radius, focus=max(0.0, best.focus + focus))
            if (after := level.cost(tried, DISC)) < cost:
                best, cost = tried, after
    return best


def _descend(level: Level, motion: FrameMotion, active: NDArray[np.int64], steps: int) -> FrameMotion:
    """Levenberg-Marquardt over the ``active`` numbers from ``motion``."""
    vector, cost, damping = motion.vector, level.cost(motion), DAMPING
    for _ in range(steps):
        matrix, side = level.normal_equations(motion, active)
        diagonal = matrix.diagonal()
        if diagonal.max() <= 0.0:
            break  # nothing to see
        for _ in range(MAX_TRIES):
            damped = matrix + np.diag(damping * diagonal + DAMPING_FLOOR * diagonal.max())
            trial = vector.copy()
            trial[active] += np.linalg.solve(damped, side)
            tried = motion.with_vector(trial)
            if (after := level.cost(tried)) < cost:
                break
            damping *= MORE_DAMPING
        else:
            break
        gain, vector, motion, cost = cost - after, trial, tried, after
        if gain < CONVERGED * cost:
            break
        damping = max(damping / 4.0, 1e-4)
    return motion


def _rotation(length: float, angle: float) -> ArrayF64:
    twist = np.zeros(TWIST)
    twist[3], twist[4] = length * math.sin(angle), length * math.cos(angle)
    return twist
