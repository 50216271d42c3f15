"""Search for the motion or the defocus under which the render looks like the frame image.

Motions are found by Levenberg-Marquardt with Huber weights, discs of defocus by a pattern search, both from
coarse to fine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cleargs.formation.comparison import COARSE, DISC, LEVELS, FramePair, Level, MotionFit
from cleargs.formation.motion import BEND, BLUR, CUBE, POSE, SKEW, TWIST, TWISTS, FrameMotion, Model
from cleargs.types import ArrayF64

SHARED_PIXELS = 50.0
"""Number of pixels whose errors count as one, where an image corrects a measured motion."""
WARM_STEPS = 2
"""Number of Gauss-Newton steps of a fit that starts from the previous one."""

LENGTHS = (2.0, 4.0, 7.0, 11.0, 16.0, 22.0, 30.0)
DIRECTIONS = 8
"""Lengths, in pixels of the coarsest level, and number of directions of the blurs that a search without a
start begins with. From no motion, a descent may end in a local minimum and miss a long blur."""
STARTS = 3
"""Number of the best of these blurs from which a descent starts. Others start from a short blur and none."""

RADII = (1.0, 2.0, 3.0, 4.5, 7.0)
"""Mean radii of the discs that a search for defocus begins with, in pixels of the coarsest level."""
NARROWING = (0.25, 0.12, 0.06)
"""Steps of the pattern search for a disc, as shares of its radius and of the range of nearness."""

MODEL_PENALTY = 0.005
"""Share of the residual that each further motion must explain to be preferred to a simpler model."""

DAMPING, MORE_DAMPING = 1e-2, 6.0
DAMPING_FLOOR = 1e-4
"""Further damping of every parameter, as a share of the largest element of the diagonal. A parameter that the
image does not determine changes little."""
CONVERGED = 1e-3
MAX_TRIES = 4

MAX_ORDER = 3
"""Highest order of a path in time."""
ORDER_PENALTY = 0.005
"""Share of the residual without any motion that each further order of the path must explain."""

BEND_SHARE = 0.01
"""Share of the difference that a path must explain at a size before a cubic path is tried at that size. Most
frames are sharp, and a cubic path has four times the unknowns of a straight one."""

_ACTIVE: dict[Model, tuple[slice, ...]] = {"blur": (BLUR,), "skew": (SKEW,), "both": (BLUR, SKEW)}
_PARTS: dict[Model, int] = {"none": 0, "blur": 1, "skew": 1, "both": 2, "defocus": 1}


def search(
    pair: FramePair,
    *,
    start: FrameMotion | None = None,  # motion with the blur to begin with; None: the best of a grid of blurs
    skew: bool = True,  # try models with a rolling shutter, which doubles the time
    defocus: bool = True,  # try a disc of defocus, which doubles the time
    pose: bool = False,  # correct the pose together with each motion
    held: FrameMotion | None = None,  # motion with a known skew, which all models have
) -> list[MotionFit]:
    """Fit every model from scratch.

    With a skew that is ``held``, no other skew is tried. Return the fit without blur first, then those of
    each model. Models with a blur have one per order of the path that was tried.
    """
    levels = pair.levels()
    coarse = levels[0]
    no_motion = replace(held or FrameMotion(), median_depth=coarse.median)
    models: tuple[Model, ...] = ("both", "blur", "skew") if skew and held is None else ("blur",)
    starts = _starts(coarse, no_motion) if start is None else _near(coarse, no_motion, start)
    begun = _best(coarse, starts, models[0], LEVELS[0][1], pose)
    found: list[tuple[Model, FrameMotion]] = [("none", no_motion)]
    for model in models:
        straight = curved = _restricted(begun, model, no_motion)
        for level, (_, steps) in zip(levels, LEVELS, strict=False):
            nearer = min((straight, no_motion), key=level.cost)
            straight = _best(level, [nearer], model, steps, pose)
            best = _promising(level, [straight, curved], no_motion) if BLUR in _ACTIVE[model] else None
            if best is not None and level is not levels[-1]:
                # At a blur of 0 all derivatives of a path are 0, and a straight path may have ended there.
                others = starts[:1] if level is coarse else []
                curved = _best(level, [best, *others], model, steps, pose, MAX_ORDER)
        found.append((model, straight))
        if best is not None and (straight.blur.any() or curved.blur.any()):
            paths = [_best(level, [straight], model, steps, pose, 2)]
            if (best := _promising(level, [*paths, curved], no_motion)) is not None:
                paths.append(_best(level, [best], model, steps, pose, MAX_ORDER))
            found += [(model, path) for path in paths]
    if defocus:
        disc = _sharpest_disc(coarse, no_motion)
        for level in levels[1:]:
            disc = _narrowed(level, disc)
        found.append(("defocus", disc))
    return [levels[-1].evaluate(named(model, no_motion), motion) for model, motion in found]


def named(model: Model, motion: FrameMotion) -> Model:
    """Return the model of a motion: with its skew, a frame of the model ``blur`` is one of ``both``."""
    with_skew: dict[Model, Model] = {"none": "skew", "blur": "both"}
    return with_skew.get(model, model) if motion.skew.any() else model


def measured_fits(pair: FramePair, motions: Sequence[FrameMotion]) -> list[MotionFit]:
    """Return two fits of measured motions: the best of ``motions``, and the same without curves.

    The best is chosen on the pixels that take part in fits.
    """
    level = pair.finest
    best = min(motions, key=level.cost)
    none = np.zeros(TWIST)
    paths = [best, replace(best, pose=none, bend=none, cube=none)]
    return [level.evaluate(named("blur", path), path) for path in paths]


@dataclass(frozen=True, eq=False)
class Measurement:
    """Measured speed of a camera, as blur and skew of a frame: both are the same twist times a duration."""

    speed: ArrayF64  # [6] px per frame of the video
    precision: ArrayF64  # [6, 6] inverse of its covariance
    exposure: float
    """Exposure time, in frames of the video."""
    readout: float
    """Readout time, likewise."""


def corrected(pair: FramePair, motion: FrameMotion, measured: Measurement, *, pose: bool) -> MotionFit:
    """Correct the speed behind blur and skew of ``motion``, held by its measurement; with ``pose``, the pose.

    Curves stay.
    """
    level = pair.finest
    parts = [POSE, BLUR, SKEW]
    active = np.concatenate([np.arange(len(TWISTS) * TWIST)[part] for part in parts])
    times = np.repeat([0.0, measured.exposure, measured.readout], TWIST)
    to_speed = times[:, None] * np.tile(np.eye(TWIST), (len(parts), 1))
    unknowns = np.hstack([np.eye(len(active))[:, :TWIST], to_speed]) if pose else to_speed
    total = measured.exposure**2 + measured.readout**2
    speed = (measured.exposure * motion.blur + measured.readout * motion.skew) / total
    variance = (1.25 * level.evaluate("blur", motion).residual) ** 2  # if errors are normal
    held = np.zeros((unknowns.shape[1], unknowns.shape[1]))
    held[-TWIST:, -TWIST:] = SHARED_PIXELS * variance * measured.precision
    before = np.concatenate([np.zeros(unknowns.shape[1] - TWIST), speed - measured.speed])
    found = _descend(level, motion, active, WARM_STEPS, unknowns, prior=(before, held))
    if not motion.blur.any():
        found = replace(found, blur=motion.blur)
    return level.evaluate(named("blur" if found.blur.any() else "none", found), found)


def refine(
    pair: FramePair,
    model: Model,
    motion: FrameMotion,
    *,
    pose: bool = False,
    curve: bool = False,
    held: FrameMotion | None = None,
) -> list[MotionFit]:
    """Fit ``model`` again at the finest level, from the ``motion`` of the last fit.

    ``pose`` corrects the pose too, and ``curve`` tries the next order of the path. The skew of ``held`` does
    not change. Return the fit of ``none`` first, then that of ``model`` if it is not ``none``, then that of
    the next order if it was tried.
    """
    level = pair.finest
    if model == "none":
        return [level.evaluate("none", FrameMotion())]
    no_motion = FrameMotion(median_depth=level.median)
    motion = replace(motion, median_depth=level.median)
    if model == "defocus":
        paths = [_narrowed(level, motion)]
    else:
        order = motion.order
        paths = [_best(level, [motion], model, WARM_STEPS, pose, order)]
        if curve and order < MAX_ORDER and BLUR in _ACTIVE[model]:
            paths.append(_best(level, paths, model, WARM_STEPS, pose, order + 1))
    return [level.evaluate("none", no_motion), *(level.evaluate(model, path) for path in paths)]


def preferred(found: list[MotionFit]) -> MotionFit:
    """Return the fit with the least residual, with penalties for further motions and orders of the path."""

    def cost(fit: MotionFit) -> float:
        model = fit.residual * (1.0 + MODEL_PENALTY * _PARTS[fit.model])
        return model + ORDER_PENALTY * fit.residual_without * (fit.motion.order - 1)

    return min(found, key=cost)


def _promising(level: Level, paths: list[FrameMotion], no_motion: FrameMotion) -> FrameMotion | None:
    """Return the best of ``paths``; None if it explains less than `BEND_SHARE` at this size."""
    costs = [level.cost(path) for path in paths]
    enough = min(costs) < (1.0 - BEND_SHARE) * level.cost(no_motion)
    return paths[costs.index(min(costs))] if enough else None


def _restricted(motion: FrameMotion, model: Model, no_motion: FrameMotion) -> FrameMotion:
    vector = no_motion.vector
    for part in (POSE, *_ACTIVE[model]):
        vector[part] = motion.vector[part]
    return motion.with_vector(vector)


def _best(
    level: Level, starts: list[FrameMotion], model: Model, steps: int, pose: bool, order: int = 1
) -> FrameMotion:
    """Return the best end of the descents from ``starts`` with a path of ``order``.

    If the pose is not corrected, the given pose is that at the middle of the exposure. On a curved path, the
    mean pose is then a twelfth of the bend away from it.
    """
    bends = order > 1
    parts = [*([POSE] if pose or bends else []), *_ACTIVE[model], *((BEND, CUBE)[: order - 1])]
    active = np.concatenate([np.arange(len(TWISTS) * TWIST)[part] for part in parts])
    unknowns = None
    if bends and not pose:
        unknowns = np.eye(len(active))[:, TWIST:]
        rows = np.arange(TWIST)
        unknowns[rows, np.searchsorted(active[TWIST:], BEND.start + rows)] = 1.0 / 12.0
    ends = [_descend(level, start, active, steps, unknowns) for start in starts]
    return min(ends, key=level.cost)


def _starts(level: Level, no_motion: FrameMotion) -> list[FrameMotion]:
    """Return the best of a grid of rotations about the camera's x and y axes, a short blur and no motion."""
    pixel = 1.0 / level.scale
    motions = [
        replace(no_motion, blur=_rotation(length * pixel, math.pi * k / DIRECTIONS))
        for length in LENGTHS
        for k in range(DIRECTIONS)
    ]
    costs = [level.cost(motion, COARSE) for motion in motions]
    first = [motions[k] for k in np.argsort(costs, kind="stable")[:STARTS]]
    return [*first, _short(level, no_motion), no_motion]


def _near(level: Level, no_motion: FrameMotion, start: FrameMotion) -> list[FrameMotion]:
    """Return ``start``, a short blur and no motion."""
    start = replace(start, median_depth=no_motion.median_depth)
    return [*([start] if start.blur.any() else []), _short(level, start), no_motion]


def _short(level: Level, motion: FrameMotion) -> FrameMotion:
    """Return a short blur along that of ``motion``.

    If the blur is 0, the derivative by the blur is 0, and a descent would not move.
    """
    length = float(np.linalg.norm(motion.blur))
    blur = motion.blur / length if length > 0.0 else _rotation(1.0, 0.0)
    return replace(motion, blur=0.5 / level.scale * blur)


def _sharpest_disc(level: Level, no_motion: FrameMotion) -> FrameMotion:
    """Return the best of a grid of discs."""
    low, middle, high = (float(q) for q in np.quantile(level.nearness, (0.05, 0.5, 0.95)))
    discs = []
    for focus in (0.0, low, middle, high, 2.0 * high):
        spread = float(np.abs(level.nearness - np.float32(focus)).mean(dtype=np.float64))
        for radius in RADII:
            discs.append(replace(no_motion, disc_px=radius / level.scale / max(spread, 1e-3), focus=focus))
    return min(discs, key=lambda disc: level.cost(disc, DISC))


def _narrowed(level: Level, disc: FrameMotion) -> FrameMotion:
    """Return the end of a pattern search around ``disc``."""
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


def _descend(
    level: Level,
    motion: FrameMotion,
    active: NDArray[np.int64],
    steps: int,
    unknowns: ArrayF64 | None = None,
    prior: tuple[ArrayF64, ArrayF64] | None = None,
) -> FrameMotion:
    """Run Levenberg-Marquardt over the ``active`` numbers from ``motion``.

    ``unknowns`` [A, U] are the combinations of the active numbers that may change; None: all of them.
    ``prior`` has the present distances [U] of these combinations from their expected values, and the matrix
    [U, U] that holds them there.
    """
    vector, cost, damping = motion.vector, level.cost(motion), DAMPING
    moved = np.zeros(len(active) if unknowns is None else unknowns.shape[1])
    for _ in range(steps):
        matrix, side = level.normal_equations(motion, active)
        if unknowns is not None:
            matrix, side = unknowns.T @ matrix @ unknowns, unknowns.T @ side
        if prior is not None:
            matrix, side = matrix + prior[1], side - prior[1] @ (prior[0] + moved)
        diagonal = matrix.diagonal()
        if diagonal.max() <= 0.0:
            break  # the image determines none of the numbers
        for _ in range(MAX_TRIES):
            damped = matrix + np.diag(damping * diagonal + DAMPING_FLOOR * diagonal.max())
            trial = vector.copy()
            change = np.linalg.solve(damped, side)
            trial[active] += change if unknowns is None else unknowns @ change
            tried = motion.with_vector(trial)
            if (after := level.cost(tried)) < cost:
                break
            damping *= MORE_DAMPING
        else:
            break
        gain, vector, motion, cost, moved = cost - after, trial, tried, after, moved + change
        if gain < CONVERGED * cost:
            break
        damping = max(damping / 4.0, 1e-4)
    return motion


def blur_along(length: float, angle: float) -> FrameMotion:
    """Return a straight blur of ``length`` px by a rotation; ``angle`` is in radians from x towards y."""
    return FrameMotion(blur=_rotation(length, math.pi - angle))


def _rotation(length: float, angle: float) -> ArrayF64:
    twist = np.zeros(TWIST)
    twist[3], twist[4] = length * math.sin(angle), length * math.cos(angle)
    return twist
