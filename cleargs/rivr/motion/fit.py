"""Finding a frame's motion: the twists under which the render looks like the raw frame."""

from __future__ import annotations

import math

import cv2
import numpy as np

from cleargs.rivr.motion.kernels import misfits, normal_equations
from cleargs.rivr.motion.model import TWIST, Floats, Motion, Vector, flow_basis, instants
from cleargs.splat.camera import Camera

LEVELS = ((160, 6), (320, 5), (640, 3))
"""Longest side in pixels and Gauss-Newton steps, from coarse to fine."""

LENGTHS = (2.0, 4.0, 7.0, 11.0, 16.0, 22.0, 30.0)
DIRECTIONS = 8
"""The blurs that a search begins with, in pixels of the coarsest level. It only goes downhill, and a long
blur lies behind hills."""
STARTS = 3
"""The best of them are followed."""

FINE, COARSE = instants(13), instants(9)
"""Instants of an exposure."""

HIGH_PASS = 6.0
"""Standard deviation in pixels of the Gaussian whose blur is taken from both images: what differs slowly, as
light does, says nothing of motion."""

OUTLIER, LIMIT = 0.03, 0.1
"""Differences of linear light from which they count linearly, and no further."""

DAMPING, MORE_DAMPING = 1e-2, 6.0
FLOOR = 1e-4
"""Damping of every direction, as a share of the stiffest: what the image does not show stays near zero."""
CONVERGED = 1e-3
TRIES = 4


def fit_motion(render: Floats, observed: Floats, weight: Floats, camera: Camera, depth: Floats) -> Motion:
    """The motion that makes ``render`` look like ``observed``; the frame's pose stays.

    Args:
        render, observed: luminance [H, W] in linear light.
        weight: [H, W], 0 where a pixel does not count.
        camera, depth: of the render; [H, W].

    Levenberg-Marquardt on the difference of high-passed images, from coarse to fine, with Huber weights.
    """
    longest = max(render.shape)
    levels = [level for level in LEVELS if level[0] < longest] or [(longest, LEVELS[0][1])]
    if levels[-1][0] < longest <= LEVELS[-1][0]:
        levels.append((longest, LEVELS[len(levels)][1]))
    motion: Vector | None = None
    for size, steps in levels:
        level = _Level(render, observed, weight, camera, depth, size / longest)
        starts = level.starts() if motion is None else [motion]
        motion = min((level.descend(start, steps) for start in starts), key=level.cost)
    assert motion is not None
    return Motion(motion[:TWIST], motion[TWIST:])


class _Level:
    """The problem at one size."""

    def __init__(
        self, render: Floats, observed: Floats, weight: Floats, camera: Camera, depth: Floats, scale: float
    ) -> None:
        height, width = (max(2, round(scale * side)) for side in render.shape)
        self._scale = scale

        def reduced(image: Floats) -> Floats:
            return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.float32)

        image, self._observed = _high_passed(reduced(render)), _high_passed(reduced(observed))
        self._weight = (reduced(weight) > 0.99).astype(np.float32)
        self._basis = flow_basis(camera, reduced(depth))
        slopes = [cv2.Sobel(image, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=0.125) for dx in (1, 0)]
        self._stack = np.ascontiguousarray(np.stack([image, *slopes], -1), np.float32)
        self._image = image
        self._sums = np.empty(height)

    def cost(self, motion: Vector, times: Floats = FINE) -> float:
        """Sum of the differences that remain, each at most `LIMIT`."""
        offset, sweep = Motion(motion[:TWIST], motion[TWIST:]).ways(self._basis)
        misfits(self._image, self._observed, self._weight, offset, sweep, times, LIMIT, self._sums)
        return float(self._sums.sum())

    def starts(self) -> list[Vector]:
        """The most promising of the rotations about the axes across the view, and nearly none."""
        pixel = 1.0 / self._scale
        motions = [_rotation(0.5 * pixel, 0.0)]
        for length in LENGTHS:
            for k in range(DIRECTIONS):
                motions.append(_rotation(length * pixel, math.pi * k / DIRECTIONS))
        costs = [self.cost(motion, COARSE) for motion in motions]
        return [motions[k] for k in np.argsort(costs, kind="stable")[:STARTS]]

    def descend(self, motion: Vector, steps: int) -> Vector:
        """Levenberg-Marquardt from ``motion``."""
        cost, damping = self.cost(motion), DAMPING
        for _ in range(steps):
            matrix, side = self._normal_equations(motion)
            diagonal = matrix.diagonal()
            if diagonal.max() <= 0.0:
                break  # nothing to see
            for _ in range(TRIES):
                damped = matrix + np.diag(damping * diagonal + FLOOR * diagonal.max())
                tried = motion + np.linalg.solve(damped, side)
                if (after := self.cost(tried)) < cost:
                    break
                damping *= MORE_DAMPING
            else:
                break
            gain, motion, cost = cost - after, tried, after
            if gain < CONVERGED * cost:
                break
            damping = max(damping / 4.0, 1e-4)
        return motion

    def _normal_equations(self, motion: Vector) -> tuple[Vector, Vector]:
        offset, sweep = Motion(motion[:TWIST], motion[TWIST:]).ways(self._basis)
        height = len(self._observed)
        matrices, sides = np.empty((height, 2 * TWIST, 2 * TWIST)), np.empty((height, 2 * TWIST))
        normal_equations(
            self._stack,
            self._observed,
            self._weight,
            self._basis,
            offset,
            sweep,
            FINE,
            OUTLIER,
            matrices,
            sides,
        )
        lower = matrices.sum(axis=0)
        return lower + np.tril(lower, -1).T, sides.sum(axis=0)


def _high_passed(image: Floats) -> Floats:
    return np.asarray(image - cv2.GaussianBlur(image, (0, 0), HIGH_PASS), np.float32)


def _rotation(length: float, angle: float) -> Vector:
    motion = np.zeros(2 * TWIST)
    motion[3], motion[4] = length * math.sin(angle), length * math.cos(angle)
    return motion
