"""Comparison of a frame image and a render under a motion, at one size.

The *residual* is the mean difference of high-passed luminance in linear light. A quarter of the pixels, in
blocks, is held out from every fit. The residual on the held-out pixels decides which model explains the
frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.formation.motion import BEND, TWIST, FrameMotion, Model, flow_basis, widened
from cleargs.formation.warp import samples
from cleargs.media.colour import LUMA, linear_from_srgb
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.cpu import backend as cpu
from cleargs.splat.kernels.warp_layout import MAX_NEARNESS, MIN_COVERED
from cleargs.types import ArrayF32, ArrayF64, MaskBool

LEVELS = ((160, 6), (320, 5), (640, 3))
"""Longest side in pixels and Gauss-Newton steps, from coarse to fine."""
NEAR_SIZE = 1.5
"""A frame at full size replaces the finest level below its size if it is larger by less than this factor."""

FINE, COARSE = samples(13), samples(9)
"""Sample times of an exposure."""
DISC = samples(32)

HIGH_PASS = 6.0
"""Standard deviation, px, of the Gaussian whose blur is subtracted from both images. Differences of low
frequency, such as those of illumination, say nothing about motion."""

OUTLIER, LIMIT = 0.03, 0.1
"""Differences of linear light. Fits count those above `OUTLIER` linearly; residuals count at most `LIMIT`."""

MIN_RESIDUAL = 5e-4
"""Residual, in linear light, below which there is nothing to explain: the error of rounding to eight bits."""

HOLDOUT_BLOCK, HOLDOUT_EVERY = 16, 4
"""Side, px, of the blocks, of which every fourth is held out."""
FIT_PIXELS = 100_000
"""Number of pixels that are enough for a fit of at most 30 numbers. In larger images fits use every second,
third, ... row (docs/experiments/formation.md#pixels-of-a-fit)."""


@dataclass(frozen=True, eq=False)
class FramePair:
    """A frame image and the render that should explain it.

    ``luminance``, ``depth`` and ``alpha`` of the render are larger than the frame by ``margin`` pixels on
    every side. ``camera`` is that of the frame.
    """

    luminance: ArrayF32  # [H + 2 margin, W + 2 margin] linear light
    depth: ArrayF32
    alpha: ArrayF32
    observed: ArrayF32  # [H, W] linear luminance
    weight: ArrayF32  # [H, W] 0 where a pixel does not count
    camera: Camera
    margin: int

    @cached_property
    def finest(self) -> Level:
        """The comparison at the largest size at which the frame is compared."""
        return Level(self, scales(self)[-1])

    def levels(self) -> list[Level]:
        """Return the comparisons at all sizes, the coarsest first."""
        return [*(Level(self, scale) for scale in scales(self)[:-1]), self.finest]


@dataclass(frozen=True, eq=False)
class MotionFit:
    """A model of a frame with the residual that it leaves."""

    model: Model
    motion: FrameMotion
    residual: float
    """Mean difference that remains on the held-out pixels, each at most `LIMIT`."""
    residual_without: float
    """Residual without any motion."""

    @property
    def explained(self) -> float:
        """Share of the residual that the model removes."""
        return explained_share(self.residual, self.residual_without)


def explained_share(residual: float, residual_without: float) -> float:
    """Return 1 - ``residual`` / ``residual_without``; 0 if the latter is at most `MIN_RESIDUAL`."""
    return 1.0 - residual / residual_without if residual_without > MIN_RESIDUAL else 0.0


def luminance(image: ArrayF32) -> ArrayF32:
    """Return the linear luminance [H, W] of an sRGB image."""
    kr, kb = LUMA["bt709"]
    # einsum, not BLAS, whose order of summation may depend on its threads.
    weights = np.array([kr, 1.0 - kr - kb, kb], np.float32)
    return np.asarray(np.einsum("hwc,c->hw", linear_from_srgb(image), weights))


def scales(pair: FramePair) -> list[float]:
    """Return the sizes at which a frame is compared, as shares of its size, the coarsest first."""
    longest = max(pair.observed.shape)
    sizes = [size for size, _ in LEVELS if size < longest] or [longest]
    if sizes[-1] < longest < NEAR_SIZE * sizes[-1]:
        sizes[-1] = longest
    elif sizes[-1] < longest <= LEVELS[-1][0]:
        sizes.append(longest)
    return [size / longest for size in sizes]


class Level:
    """The comparison of a frame and a render at one size."""

    def __init__(self, pair: FramePair, scale: float) -> None:
        """Reduce both images to ``scale`` times the size of the frame."""
        margin = pair.margin
        height, width = pair.luminance.shape
        size = max(2, round(scale * width)), max(2, round(scale * height))

        def reduced(image: ArrayF32) -> ArrayF32:
            return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)

        inner = np.s_[margin : height - margin, margin : width - margin]
        # Around the frame, both images show the render, so that both are high-passed alike at the border.
        observed, weight = pair.luminance.copy(), np.zeros_like(pair.luminance)
        observed[inner], weight[inner] = pair.observed, pair.weight
        self._image, self._observed = _high_passed(reduced(pair.luminance)), _high_passed(reduced(observed))
        counted = (reduced(weight) > 0.99).astype(np.float32)
        row, column = (np.arange(side) // HOLDOUT_BLOCK for side in counted.shape)
        holdout = (column[None] + 2 * row[:, None]) % HOLDOUT_EVERY == 0  # no two blocks share a side
        every = max(1, counted.size // FIT_PIXELS)
        fitting = ~holdout * (np.arange(len(counted)) % every == 0)[:, None] * np.float32(every)
        self._fitting, self._holdout = counted * fitting, counted * holdout
        if not self._holdout.any():  # an image of a few blocks
            self._holdout = self._fitting = counted
        self._fitting_rows, self._every_row = self._fitting.any(axis=1), np.ones(len(counted), np.bool_)
        self._total = max(float(self._holdout.sum(dtype=np.float64)), 1.0)
        # A copy, because the pair and its finest level would keep each other in memory.
        self._pair, self._reduced = replace(pair), reduced
        self._skewed: tuple[bytes, ArrayF32] | None = None  # the last rolling shutter, and its displacements
        self.scale = size[0] / width
        self._across, self._down = (
            (((np.arange(reduced_side) + 0.5) * side / reduced_side - margin) / own - 0.5).astype(np.float32)
            for reduced_side, side, own in zip(
                size, (width, height), (pair.camera.width, pair.camera.height), strict=True
            )
        )

    # Only a fit needs the next properties. The residual without any motion is computed without them.

    @cached_property
    def median(self) -> float:
        """Median depth of the render."""
        depth, alpha = self._pair.depth[::4, ::4], self._pair.alpha[::4, ::4]
        seen = (alpha > MIN_COVERED) & (depth > 0.0)
        return float(np.median(depth[seen] / alpha[seen])) if seen.any() else 1.0

    @cached_property
    def nearness(self) -> ArrayF32:
        """Median depth over depth, [H, W], as in the kernel `displacements`."""
        depth, alpha = self._reduced_depth
        seen = (alpha > MIN_COVERED) & (depth > 0.0)
        near = np.ones_like(depth)
        near[seen] = np.minimum(np.float32(self.median) * alpha[seen] / depth[seen], MAX_NEARNESS)
        return near

    @cached_property
    def _reduced_depth(self) -> tuple[ArrayF32, ArrayF32]:
        """Accumulated depth and alpha, [H, W] each."""
        return self._reduced(self._pair.depth), self._reduced(self._pair.alpha)

    @cached_property
    def _basis(self) -> ArrayF32:
        return flow_basis(widened(self._pair.camera, self._pair.margin), self.nearness)

    @cached_property
    def _smooth(self) -> ArrayF32:
        """The image whose slopes a fit follows, smoothed by [1 2 1] / 4 along both axes."""
        return np.asarray(cv2.GaussianBlur(self._image, (3, 3), 0.0), np.float32)

    @cached_property
    def _nowhere(self) -> ArrayF32:  # [H, W]
        return np.zeros_like(self._image)

    @cached_property
    def _still(self) -> float:
        """Residual without any motion."""
        nowhere = np.zeros((2, *self._image.shape), np.float32)
        fields = nowhere, nowhere, nowhere[0], None
        total = cpu.residual(self._image, self._observed, self._holdout, fields, samples(1), LIMIT)
        return total / self._total

    def evaluate(self, model: Model, motion: FrameMotion) -> MotionFit:
        """Return the residual of a motion on the held-out pixels."""
        residual = self._still
        if model != "none":
            times = DISC if model == "defocus" else FINE
            residual = self._residual(motion, times, self._holdout, self._every_row) / self._total
        return MotionFit(model, motion, residual, self._still)

    def cost(self, motion: FrameMotion, times: ArrayF32 = FINE) -> float:
        """Return the sum of the differences on the pixels that are not held out."""
        return self._residual(motion, times, self._fitting, self._fitting_rows)

    def _residual(self, motion: FrameMotion, times: ArrayF32, weight: ArrayF32, rows: MaskBool) -> float:
        fields = self._fields(motion, motion.order > 1, rows)
        return cpu.residual(self._image, self._observed, weight, fields, times, LIMIT)

    def _fields(
        self, motion: FrameMotion, curved: bool, rows: MaskBool
    ) -> tuple[ArrayF32, ArrayF32, ArrayF32, ArrayF32 | None]:
        """Return offset, sweep, radius and, where ``curved``, curve: see `DisplacementFields`.

        Those of a motion are only computed in ``rows`` [H].
        """
        twists = [motion.pose, motion.blur, *([motion.bend, motion.cube] if curved else [])]
        flows = cpu.flows(self._basis, np.stack(twists), rows)
        offset, sweep = flows[:2]
        if motion.skew.any():
            offset += self._read(motion)
        radius = self._nowhere
        if motion.disc_px > 0.0:
            disc = np.float32(motion.disc_px * self.scale)
            radius = np.abs(self.nearness - np.float32(motion.focus)) * disc
        return offset, sweep, radius, flows[2:].reshape(4, *radius.shape) if curved else None

    def _read(self, motion: FrameMotion) -> ArrayF32:
        """Return the displacements [2, H, W] by the rolling shutter alone. Those of the last one are kept."""
        twists = np.stack([np.zeros(TWIST), motion.skew, motion.skew_bend])
        key = twists.tobytes() + bytes([motion.columns])
        if self._skewed is not None and self._skewed[0] == key:
            return self._skewed[1]
        camera = widened(self._pair.camera, self._pair.margin)
        height, width = self._image.shape
        right, down = width / camera.width, height / camera.height
        lens = [right * camera.fx, down * camera.fy, right * camera.cx, down * camera.cy, self.median]
        columns = np.float32(motion.columns)
        read = cpu.read_displacements(
            *self._reduced_depth,
            np.array(lens, np.float32),
            (right * twists).astype(np.float32),
            (1 - columns) * self._down,
            columns * self._across,
        )
        self._skewed = key, read
        return read

    def normal_equations(self, motion: FrameMotion, active: NDArray[np.int64]) -> tuple[ArrayF64, ArrayF64]:
        """Return matrix and right side of a Gauss-Newton step over the ``active`` numbers of the motion."""
        curved = bool((active >= BEND.start).any()) or motion.order > 1
        offset, sweep, _, curve = self._fields(motion, curved, self._fitting_rows)
        return cpu.normal_equations(
            self._image,
            self._smooth,
            self._observed,
            self._fitting,
            self._basis,
            self._down,
            offset,
            sweep,
            curve,
            FINE[:, 0].copy(),
            OUTLIER,
            active,
        )


def _high_passed(image: ArrayF32) -> ArrayF32:
    return np.asarray(image - cv2.GaussianBlur(image, (0, 0), HIGH_PASS), np.float32)
