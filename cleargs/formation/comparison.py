"""How well numbers of a motion explain a raw frame: the comparison of frame and render at one size.

The difference of high-passed luminance in linear light counts. A quarter of the pixels, in blocks, takes no
part in a fit: they judge which model explains the frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.formation.motion import FrameMotion, Model, flow_basis, widened
from cleargs.formation.warp import samples
from cleargs.media.colour import LUMA, linear_from_srgb
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.cpu import backend as cpu
from cleargs.splat.kernels.warp_layout import MAX_NEARNESS, MIN_COVERED
from cleargs.types import ArrayF32, ArrayF64, MaskBool

LEVELS = ((160, 6), (320, 5), (640, 3))
"""Longest side in pixels and Gauss-Newton steps, from coarse to fine."""
NEAR_SIZE = 1.5
"""An image that is larger than a level by less is that level itself."""

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

HOLDOUT_BLOCK, HOLDOUT_EVERY = 16, 4
"""Side in pixels of the blocks of which every fourth judges."""


@dataclass(frozen=True, eq=False)
class FramePair:
    """A raw frame and the render that should explain it.

    ``luminance``, ``depth`` and ``alpha`` of the render are larger than the frame by ``margin`` pixels on
    every side; ``camera`` is the frame's.
    """

    luminance: ArrayF32  # [H + 2 margin, W + 2 margin] linear light
    depth: ArrayF32
    alpha: ArrayF32
    observed: ArrayF32  # [H, W] linear luminance
    weight: ArrayF32  # [H, W] 0 where a pixel does not count
    camera: Camera
    margin: int


@dataclass(frozen=True, eq=False)
class MotionFit:
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


def luminance(image: ArrayF32) -> ArrayF32:
    """Linear luminance [H, W] of an sRGB image."""
    kr, kb = LUMA["bt709"]
    # einsum, not BLAS, whose order of summation may depend on its threads.
    weights = np.array([kr, 1.0 - kr - kb, kb], np.float32)
    return np.asarray(np.einsum("hwc,c->hw", linear_from_srgb(image), weights))


def scales(pair: FramePair) -> list[float]:
    """The sizes at which a frame is compared, as shares of its own, the coarsest first."""
    longest = max(pair.observed.shape)
    sizes = [size for size, _ in LEVELS if size < longest] or [longest]
    if sizes[-1] < longest < NEAR_SIZE * sizes[-1]:
        sizes[-1] = longest
    elif sizes[-1] < longest <= LEVELS[-1][0]:
        sizes.append(longest)
    return [size / longest for size in sizes]


class SearchKernels(Protocol):
    """Kernels that a search for a frame's motion runs; the CPU's back end has them, others may be passed."""

    def misfit(
        self,
        image: ArrayF32,
        observed: ArrayF32,
        weight: ArrayF32,
        fields: tuple[ArrayF32, ArrayF32, ArrayF32],
        samples: ArrayF32,
        limit: float,
    ) -> float:
        """Return the sum of weight * min(|observed - exposed image|, limit)."""

    def normal_equations(
        self,
        stack: ArrayF32,
        observed: ArrayF32,
        weight: ArrayF32,
        basis: ArrayF32,
        down: ArrayF32,
        offset: ArrayF32,
        sweep: ArrayF32,
        times: ArrayF32,
        outlier: float,
        active: NDArray[np.int64],
    ) -> tuple[ArrayF64, ArrayF64]:
        """Return matrix [A, A] and right side [A] of a Gauss-Newton step over the ``active`` numbers."""


class Level:
    """The problem at one size."""

    def __init__(self, pair: FramePair, scale: float, kernels: SearchKernels = cpu) -> None:
        self._kernels = kernels
        margin = pair.margin
        height, width = pair.luminance.shape
        size = max(2, round(scale * width)), max(2, round(scale * height))

        def reduced(image: ArrayF32) -> ArrayF32:
            return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)

        inner = np.s_[margin : height - margin, margin : width - margin]
        # Beyond the frame's border the render stands in, so that both are high-passed alike there.
        observed, weight = pair.luminance.copy(), np.zeros_like(pair.luminance)
        observed[inner], weight[inner] = pair.observed, pair.weight
        self._image, self._observed = _high_passed(reduced(pair.luminance)), _high_passed(reduced(observed))
        counted = (reduced(weight) > 0.99).astype(np.float32)
        holdout = _holdout_mask(counted.shape)
        self._fitting, self._holdout = counted * ~holdout, counted * holdout
        if not self._holdout.any():  # an image of a few blocks
            self._holdout = self._fitting = counted
        self._total = float(self._holdout.sum(dtype=np.float64))
        depth, alpha = reduced(pair.depth), reduced(pair.alpha)
        self.median = _median_depth(pair)
        self.nearness = _nearness(depth, alpha, self.median)
        self._basis = flow_basis(widened(pair.camera, margin), self.nearness)
        self.scale = size[0] / width
        rows = (np.arange(size[1]) + 0.5) * height / size[1] - margin
        self._down = (rows / pair.camera.height - 0.5).astype(np.float32)
        slopes = [cv2.Sobel(self._image, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=0.125) for dx in (1, 0)]
        self._stack = np.ascontiguousarray(np.stack([self._image, *slopes], -1), np.float32)

    def evaluate(self, model: Model, motion: FrameMotion) -> MotionFit:
        """How well a motion explains the pixels that judge."""
        total = max(self._total, 1.0)
        still = self._misfit(FrameMotion(), FINE, self._holdout) / total
        misfit = still
        if model != "none":
            times = DISC if model == "defocus" else FINE
            misfit = self._misfit(motion, times, self._holdout) / total
        return MotionFit(model, motion, misfit, still)

    def cost(self, motion: FrameMotion, times: ArrayF32 = FINE) -> float:
        """What is left on the pixels that fit."""
        return self._misfit(motion, times, self._fitting)

    def _misfit(self, motion: FrameMotion, times: ArrayF32, weight: ArrayF32) -> float:
        fields = self.fields(motion)
        return self._kernels.misfit(self._image, self._observed, weight, fields, times, LIMIT)

    def fields(self, motion: FrameMotion) -> tuple[ArrayF32, ArrayF32, ArrayF32]:
        """Offset, sweep and radius: see `DisplacementFields`."""

        def flow(twist: ArrayF64) -> ArrayF32:
            if not twist.any():
                return np.zeros(self._basis.shape[1:], np.float32)
            # einsum, for its fixed order of summation.
            return np.asarray(np.einsum("n,nchw->chw", twist.astype(np.float32), self._basis))

        offset = flow(motion.pose) + flow(motion.skew) * self._down[:, None]
        radius = np.abs(self.nearness - np.float32(motion.focus)) * np.float32(motion.disc_px * self.scale)
        return offset, flow(motion.blur), radius

    def normal_equations(self, motion: FrameMotion, active: NDArray[np.int64]) -> tuple[ArrayF64, ArrayF64]:
        """Matrix and right side of a Gauss-Newton step over the ``active`` numbers of the motion."""
        offset, sweep, _ = self.fields(motion)
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


def _holdout_mask(shape: tuple[int, ...]) -> MaskBool:
    """True in every fourth block, no two of which share a side: bool [H, W]."""
    row, column = (np.arange(side) // HOLDOUT_BLOCK for side in shape)
    return np.asarray((column[None] + 2 * row[:, None]) % HOLDOUT_EVERY == 0)


def _median_depth(pair: FramePair) -> float:
    depth, alpha = pair.depth[::4, ::4], pair.alpha[::4, ::4]
    seen = (alpha > MIN_COVERED) & (depth > 0.0)
    return float(np.median(depth[seen] / alpha[seen])) if seen.any() else 1.0


def _nearness(depth: ArrayF32, alpha: ArrayF32, median: float) -> ArrayF32:
    """As in the kernel `displacements`."""
    seen = (alpha > MIN_COVERED) & (depth > 0.0)
    near = np.ones_like(depth)
    near[seen] = np.minimum(np.float32(median) * alpha[seen] / depth[seen], MAX_NEARNESS)
    return near


def _high_passed(image: ArrayF32) -> ArrayF32:
    return np.asarray(image - cv2.GaussianBlur(image, (0, 0), HIGH_PASS), np.float32)
