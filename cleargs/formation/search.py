"""Finding what happened while a frame was taken: under which numbers the render looks like the raw frame.

Levenberg-Marquardt on the difference of high-passed luminance in linear light, from coarse to fine, with
Huber weights. A quarter of the pixels, in blocks, takes no part in it: they judge which model explains the
frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.formation.motion import TWIST, Floats, FrameMotion, Model, Vector, flow_basis
from cleargs.formation.warp import samples
from cleargs.media.colour import LUMA, linear_from_srgb
from cleargs.splat.backend import SearchKernels, search_kernels
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.warp_layout import MAX_NEARNESS, MIN_COVERED

LEVELS = ((160, 6), (320, 5), (640, 3))
"""Longest side in pixels and Gauss-Newton steps, from coarse to fine."""
NEAR_SIZE = 1.5
"""An image that is larger than a level by less is that level itself."""
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

FINE, COARSE = samples(13), samples(9)
"""Sample times of an exposure."""
DISC = samples(32)

HIGH_PASS = 6.0
"""Standard deviation in pixels of the Gaussian whose blur is taken from both images: what differs slowly, as
light does, says nothing of motion."""

OUTLIER, LIMIT = 0.03, 0.1
"""Differences of linear light from which they count linearly, and no further."""

MIN_MISFIT = 5e-4
"""Misfit, in linear light, below which there is nothing to explain: what rounding to eight bits leaves."""

JUDGE_BLOCK, JUDGE_EVERY = 16, 4
"""Side in pixels of the blocks of which every fourth judges."""

PRICE = 0.005
"""Share of the misfit that each further motion must explain to be preferred to a simpler model."""

DAMPING, MORE_DAMPING = 1e-2, 6.0
FLOOR = 1e-4
"""Damping of every direction, as a share of the stiffest: what the image does not show stays near zero."""
CONVERGED = 1e-3
TRIES = 4

POSE, BLUR, SKEW = (slice(k * TWIST, (k + 1) * TWIST) for k in range(3))
_ACTIVE: dict[Model, tuple[slice, ...]] = {"blur": (BLUR,), "skew": (SKEW,), "both": (BLUR, SKEW)}
_PARTS: dict[Model, int] = {"none": 0, "blur": 1, "skew": 1, "both": 2, "defocus": 1}


@dataclass(frozen=True, eq=False)
class Sight:
    """A raw frame and the render that should explain it.

    ``luminance``, ``depth`` and ``alpha`` of the render are larger than the frame by ``margin`` pixels on
    every side; ``camera`` is the frame's.
    """

    luminance: Floats  # [H + 2 margin, W + 2 margin] linear light
    depth: Floats
    alpha: Floats
    observed: Floats  # [H, W] linear luminance
    weight: Floats  # [H, W] 0 where a pixel does not count
    camera: Camera
    margin: int


@dataclass(frozen=True, eq=False)
class Explanation:
    """A model of a frame, and how well it explains it."""

    model: Model
    motion: FrameMotion
    misfit: float
    """Mean difference that remains on the judging pixels, each at most `LIMIT`."""
    misfit_still: float
    """The same without any motion."""

    @property
    def explained(self) -> float:
        """Share of the misfit that the model takes away."""
        return explained_share(self.misfit, self.misfit_still)


def explained_share(misfit: float, misfit_still: float) -> float:
    """Share of ``misfit_still`` that is gone in ``misfit``; 0 where there was next to nothing."""
    return 1.0 - misfit / misfit_still if misfit_still > MIN_MISFIT else 0.0


def search(
    sight: Sight, *, skew: bool = True, pose: bool = False, kernels: SearchKernels | None = None
) -> list[Explanation]:
    """Every model at its best, from scratch. The first is ``none``.

    skew: whether models with a rolling shutter are tried too; without them it takes half the time.
    pose: whether a correction of the pose is sought beside each motion.
    kernels: what it computes with; None: the CPU's.
    """
    levels = [_Level(sight, scale, kernels) for scale in _scales(sight)]
    coarse = levels[0]
    still = FrameMotion(median_depth=coarse.median)
    models: tuple[Model, ...] = ("both", "blur", "skew") if skew else ("blur",)
    start = coarse.best(coarse.starts(still), models[0], LEVELS[0][1], pose)
    found: dict[Model, FrameMotion] = {}
    for model in models:
        motion = _restricted(start, model)
        for level, (_, steps) in zip(levels, LEVELS, strict=False):
            motion = level.best([motion, still], model, steps, pose)
        found[model] = motion
    disc = coarse.sharpest_disc(still)
    for level in levels[1:]:
        disc = level.narrowed(disc)
    found["defocus"] = disc
    return [levels[-1].judged("none", still), *(levels[-1].judged(name, found[name]) for name in found)]


def refine(
    sight: Sight,
    model: Model,
    motion: FrameMotion,
    *,
    pose: bool = False,
    kernels: SearchKernels | None = None,
) -> list[Explanation]:
    """``model`` again, from the numbers of the last fit, at the finest level; the first is ``none``."""
    level = _Level(sight, _scales(sight)[-1], kernels)
    still = FrameMotion(median_depth=level.median)
    motion = replace(motion, median_depth=level.median)
    if model == "defocus":
        motion = level.narrowed(motion)
    elif model != "none":
        motion = level.best([motion], model, WARM_STEPS, pose)
    return [level.judged("none", still), level.judged(model, motion)]


def preferred(found: list[Explanation]) -> Explanation:
    """The model with the least misfit on the pixels that judge, simpler ones at a discount."""
    return min(found, key=lambda e: e.misfit * (1.0 + PRICE * _PARTS[e.model]))


def luminance(image: Floats) -> Floats:
    """Linear luminance [H, W] of an sRGB image."""
    kr, kb = LUMA["bt709"]
    # einsum, not BLAS, whose order of summation may depend on its threads.
    weights = np.array([kr, 1.0 - kr - kb, kb], np.float32)
    return np.asarray(np.einsum("hwc,c->hw", linear_from_srgb(image), weights))


def _scales(sight: Sight) -> list[float]:
    """The sizes at which a frame is compared, as shares of its own, the coarsest first."""
    longest = max(sight.observed.shape)
    sizes = [size for size, _ in LEVELS if size < longest] or [longest]
    if sizes[-1] < longest < NEAR_SIZE * sizes[-1]:
        sizes[-1] = longest
    elif sizes[-1] < longest <= LEVELS[-1][0]:
        sizes.append(longest)
    return [size / longest for size in sizes]


def _restricted(motion: FrameMotion, model: Model) -> FrameMotion:
    vector = np.zeros(3 * TWIST)
    for part in (POSE, *_ACTIVE[model]):
        vector[part] = motion.vector[part]
    return motion.with_vector(vector)


class _Level:
    """The problem at one size."""

    def __init__(self, sight: Sight, scale: float, kernels: SearchKernels | None) -> None:
        self._kernels = kernels or search_kernels()
        margin = sight.margin
        height, width = sight.luminance.shape
        size = max(2, round(scale * width)), max(2, round(scale * height))

        def reduced(image: Floats) -> Floats:
            return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)

        inner = np.s_[margin : height - margin, margin : width - margin]
        # Beyond the frame's border the render stands in, so that both are high-passed alike there.
        observed, weight = sight.luminance.copy(), np.zeros_like(sight.luminance)
        observed[inner], weight[inner] = sight.observed, sight.weight
        self._image, self._observed = _high_passed(reduced(sight.luminance)), _high_passed(reduced(observed))
        counted = (reduced(weight) > 0.99).astype(np.float32)
        judging = _judging(counted.shape)
        self._fitting, self._judging = counted * ~judging, counted * judging
        if not self._judging.any():  # an image of a few blocks
            self._judging = self._fitting = counted
        self._total = float(self._judging.sum(dtype=np.float64))
        depth, alpha = reduced(sight.depth), reduced(sight.alpha)
        self.median = _median_depth(sight)
        self._nearness = _nearness(depth, alpha, self.median)
        self._camera = replace(
            sight.camera,
            width=width,
            height=height,
            cx=sight.camera.cx + margin,
            cy=sight.camera.cy + margin,
        )
        self._basis = flow_basis(self._camera, self._nearness)
        self._scale = size[0] / width
        rows = (np.arange(size[1]) + 0.5) * height / size[1] - margin
        self._down = (rows / sight.camera.height - 0.5).astype(np.float32)
        slopes = [cv2.Sobel(self._image, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=0.125) for dx in (1, 0)]
        self._stack = np.ascontiguousarray(np.stack([self._image, *slopes], -1), np.float32)

    def judged(self, model: Model, motion: FrameMotion) -> Explanation:
        """How well a motion explains the pixels that judge."""
        total = max(self._total, 1.0)
        still = self._misfit(FrameMotion(), FINE, self._judging) / total
        misfit = (
            still if model == "none" else self._misfit(motion, _samples_for(model), self._judging) / total
        )
        return Explanation(model, motion, misfit, still)

    def best(self, starts: list[FrameMotion], model: Model, steps: int, pose: bool) -> FrameMotion:
        """The best end of the descents from ``starts``."""
        parts = (POSE, *_ACTIVE[model]) if pose else _ACTIVE[model]
        active = np.concatenate([np.arange(3 * TWIST)[part] for part in parts])
        ends = [self._descend(start, active, steps) for start in starts]
        return min(ends, key=self._cost)

    def starts(self, still: FrameMotion) -> list[FrameMotion]:
        """The most promising of the rotations about the axes across the view, and none."""
        pixel = 1.0 / self._scale
        motions = [
            replace(still, blur=_rotation(length * pixel, math.pi * k / DIRECTIONS))
            for length in LENGTHS
            for k in range(DIRECTIONS)
        ]
        costs = [self._cost(motion, COARSE) for motion in motions]
        first = [motions[k] for k in np.argsort(costs, kind="stable")[:STARTS]]
        # Short: at none the slope by the blur vanishes, and the descent would stay there.
        return [*first, replace(still, blur=_rotation(0.5 * pixel, 0.0)), still]

    def sharpest_disc(self, still: FrameMotion) -> FrameMotion:
        """The best of a grid of discs."""
        low, middle, high = (float(q) for q in np.quantile(self._nearness, (0.05, 0.5, 0.95)))
        discs = []
        for focus in (0.0, low, middle, high, 2.0 * high):
            spread = float(np.abs(self._nearness - np.float32(focus)).mean(dtype=np.float64))
            for radius in RADII:
                discs.append(replace(still, disc_px=radius / self._scale / max(spread, 1e-3), focus=focus))
        return min(discs, key=lambda disc: self._cost(disc, DISC))

    def narrowed(self, disc: FrameMotion) -> FrameMotion:
        """The end of a pattern search around ``disc``."""
        best, cost = disc, self._cost(disc, DISC)
        span = float(np.ptp(np.quantile(self._nearness, (0.05, 0.95)))) + 0.1
        for step in NARROWING:
            for radius, focus in (
                (1 + step, 0.0),
                (1 / (1 + step), 0.0),
                (1.0, step * span),
                (1.0, -step * span),
            ):
                tried = replace(best, disc_px=best.disc_px * radius, focus=max(0.0, best.focus + focus))
                if (after := self._cost(tried, DISC)) < cost:
                    best, cost = tried, after
        return best

    def _cost(self, motion: FrameMotion, times: Floats | None = None) -> float:
        """What is left on the pixels that fit."""
        return self._misfit(motion, FINE if times is None else times, self._fitting)

    def _misfit(self, motion: FrameMotion, times: Floats, weight: Floats) -> float:
        fields = self._fields(motion)
        return self._kernels.misfit(self._image, self._observed, weight, fields, times, LIMIT)

    def _fields(self, motion: FrameMotion) -> tuple[Floats, Floats, Floats]:
        """Offset, sweep and radius: see `DisplacementFields`."""

        def flow(twist: Vector) -> Floats:
            if not twist.any():
                return np.zeros(self._basis.shape[1:], np.float32)
            # einsum, for its fixed order of summation.
            return np.asarray(np.einsum("n,nchw->chw", twist.astype(np.float32), self._basis))

        offset = flow(motion.pose) + flow(motion.skew) * self._down[:, None]
        radius = np.abs(self._nearness - np.float32(motion.focus)) * np.float32(motion.disc_px * self._scale)
        return offset, flow(motion.blur), radius

    def _descend(self, motion: FrameMotion, active: Vector, steps: int) -> FrameMotion:
        """Levenberg-Marquardt over the ``active`` numbers from ``motion``."""
        vector, cost, damping = motion.vector, self._cost(motion), DAMPING
        for _ in range(steps):
            matrix, side = self._normal_equations(motion, active)
            diagonal = matrix.diagonal()
            if diagonal.max() <= 0.0:
                break  # nothing to see
            for _ in range(TRIES):
                damped = matrix + np.diag(damping * diagonal + FLOOR * diagonal.max())
                trial = vector.copy()
                trial[active] += np.linalg.solve(damped, side)
                tried = motion.with_vector(trial)
                if (after := self._cost(tried)) < cost:
                    break
                damping *= MORE_DAMPING
            else:
                break
            gain, vector, motion, cost = cost - after, trial, tried, after
            if gain < CONVERGED * cost:
                break
            damping = max(damping / 4.0, 1e-4)
        return motion

    def _normal_equations(self, motion: FrameMotion, active: Vector) -> tuple[Vector, Vector]:
        offset, sweep, _ = self._fields(motion)
        return self._kernels.normal_equations(
            self._stack,
            self._observed,
            self._fitting,
            self._basis,
            self._down,
            offset,
            sweep,
            FINE[:, 0].copy(),
            OUTLIER,
            active,
        )


def _samples_for(model: Model) -> Floats:
    return DISC if model == "defocus" else FINE


def _judging(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """True in every fourth block, no two of which share a side: bool [H, W]."""
    row, column = (np.arange(side) // JUDGE_BLOCK for side in shape)
    return np.asarray((column[None] + 2 * row[:, None]) % JUDGE_EVERY == 0)


def _median_depth(sight: Sight) -> float:
    depth, alpha = sight.depth[::4, ::4], sight.alpha[::4, ::4]
    seen = (alpha > MIN_COVERED) & (depth > 0.0)
    return float(np.median(depth[seen] / alpha[seen])) if seen.any() else 1.0


def _nearness(depth: Floats, alpha: Floats, median: float) -> Floats:
    """As in the kernel `displacements`."""
    seen = (alpha > MIN_COVERED) & (depth > 0.0)
    near = np.ones_like(depth)
    near[seen] = np.minimum(np.float32(median) * alpha[seen] / depth[seen], MAX_NEARNESS)
    return near


def _high_passed(image: Floats) -> Floats:
    return np.asarray(image - cv2.GaussianBlur(image, (0, 0), HIGH_PASS), np.float32)


def _rotation(length: float, angle: float) -> Vector:
    twist = np.zeros(TWIST)
    twist[3], twist[4] = length * math.sin(angle), length * math.cos(angle)
    return twist
