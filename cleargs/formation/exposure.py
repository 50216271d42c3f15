"""Exposure compensation: one affine on sRGB per frame, learned with the scene if a capture needs it.

The affines start from gains that are measured at the sparse points. Their weighted median stays the identity.
This prevents a common drift of scene and affines, and a few badly exposed frames do not make the scene darker
or brighter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.parquet import read_table, write_table
from cleargs.splat.sparse_points import SparsePoints
from cleargs.splat.tables import EXPOSURE
from cleargs.splat.views import TrainingView

IDENTITY = np.eye(3, 4)
"""The affine that changes nothing, [3, 4]: matrix and offset."""

MIN_POINTS = 20
"""Fewest sparse points from which a frame's gain is measured."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """The affine of every frame: frame colour = affine[:, :3] @ scene colour + affine[:, 3], in sRGB."""

    frame_ids: NDArray[np.int32]  # [F] ascending
    affines: NDArray[np.float64]  # [F, 3, 4]

    @classmethod
    def identity(cls, frame_ids: Sequence[int]) -> Exposure:
        """Return the exposure that changes nothing, for these frames."""
        unique = np.unique(np.asarray(frame_ids, np.int32))
        return cls(unique, np.tile(IDENTITY, (len(unique), 1, 1)))

    @classmethod
    def from_gains(cls, frame_ids: Sequence[int], gains: NDArray[np.float64]) -> Exposure:
        """Return the exposure that multiplies each channel of a frame by its gain over the median gain.

        ``frame_ids`` must be distinct. A frame whose gains [F, 3] are NaN is not changed.
        """
        known = gains[np.isfinite(gains).all(axis=1)]
        relative = gains / np.median(known, axis=0) if len(known) else gains
        order = np.argsort(np.asarray(frame_ids))
        start = np.where(np.isfinite(relative), relative, 1.0)[order, :, None] * IDENTITY
        return cls(np.asarray(frame_ids, np.int32)[order], start)

    @property
    def enabled(self) -> bool:
        """True if any affine differs from the identity."""
        return bool((self.affines != IDENTITY).any())

    def of(self, frame_id: int) -> NDArray[np.float64]:
        """Return the affine [3, 4] of a frame; the identity if it has none."""
        index = np.flatnonzero(self.frame_ids == frame_id)
        return self.affines[index[0]] if len(index) else IDENTITY


def centred(affines: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift the affines [F, 3, 4] so that the median of each entry is that of the identity.

    The median is the lower one, weighted by ``weights`` [F].
    """
    total = weights.sum()
    if total <= 0.0:
        return affines
    order = np.argsort(affines, axis=0, kind="stable")
    middle = (np.cumsum(weights[order], axis=0) >= 0.5 * total).argmax(axis=0)[None]
    median = np.take_along_axis(affines, np.take_along_axis(order, middle, axis=0), axis=0)
    return np.asarray(affines - (median - IDENTITY), np.float64)


def frame_gains(views: Sequence[TrainingView], sparse: SparsePoints) -> NDArray[np.float64]:
    """Return the gain of each sRGB channel of each view, its level over the average: [V, 3], NaN: unknown.

    The gain is the median of a ratio over the sparse points that the view observes: the pixel at the
    projection of the point over the colour of the point.
    """
    gains = np.full((len(views), 3), np.nan)
    for index, (view, seen) in enumerate(zip(views, sparse.observed, strict=True)):
        camera = view.camera
        pose = camera.world_to_camera
        in_camera = np.einsum("ni,ji->nj", sparse.xyz[seen], pose[:3, :3]) + pose[:3, 3]
        depth = np.where(in_camera[:, 2] > 1e-3, in_camera[:, 2], np.nan)
        column = np.floor(in_camera[:, 0] / depth * camera.fx + camera.cx)
        row = np.floor(in_camera[:, 1] / depth * camera.fy + camera.cy)
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        image, mask = view.load()
        rows, columns = row[inside].astype(np.int64), column[inside].astype(np.int64)
        white = 1.0 if image.dtype == np.uint8 else 255.0
        shown = image[rows, columns].astype(np.float64) * white
        mean = sparse.rgb[seen][inside].astype(np.float64)
        # Near black and white a ratio says nothing about exposure.
        usable = ((mean > 10.0) & (mean < 245.0)).all(axis=1)
        if mask is not None:
            usable &= mask[rows, columns]
        if usable.sum() >= MIN_POINTS:
            gains[index] = np.median(shown[usable] / mean[usable], axis=0)
    return gains


def gain_spread(gains: NDArray[np.float64]) -> tuple[float, float]:
    """Return the standard deviations of the known log ``gains`` [F, 3] (0.05: about 5 %).

    The first is that of the brightness (their mean over the channels), the second the largest of the channels
    without the brightness: a change of white balance. Both are 0 with fewer than two frames.
    """
    known = np.log(np.maximum(gains[np.isfinite(gains).all(axis=1)], 1e-3))
    if len(known) < 2:
        return 0.0, 0.0
    brightness = known.mean(axis=1, keepdims=True)
    return float(brightness.std()), float((known - brightness).std(axis=0).max())


def write_exposure(path: Path, exposure: Exposure) -> None:
    """Write ``exposure.parquet``."""
    columns = {f"a{i}{j}": exposure.affines[:, i, j] for i in range(3) for j in range(4)}
    write_table(path, pa.table({"frame_id": exposure.frame_ids, **columns}), EXPOSURE)


def read_exposure(path: Path) -> Exposure:
    """Read ``exposure.parquet``.

    Raises:
        StoreError: The file is missing or damaged.
    """
    table = read_table(path, EXPOSURE)
    affines = np.stack([table.column(name).to_numpy() for name in EXPOSURE.names[1:]], axis=1)
    return Exposure(table.column("frame_id").to_numpy(), affines.reshape(-1, 3, 4))


class AffineOptimiser:
    """Adam for the affines. A step changes one frame's affine; then all are shifted as in `centred`."""

    def __init__(self, exposure: Exposure, weights: NDArray[np.float64], rate: float) -> None:
        """Start from ``exposure`` of all frames. ``weights`` [F] are their weights in the median."""
        self.frame_ids = exposure.frame_ids
        self.affines = centred(exposure.affines, weights)
        self.first = np.zeros_like(self.affines)
        self.second = np.zeros_like(self.affines)
        self.steps = np.zeros(len(self.frame_ids), np.int64)
        self._weights = weights
        self._rate = rate
        self._index = {int(frame_id): index for index, frame_id in enumerate(self.frame_ids)}

    @property
    def exposure(self) -> Exposure:
        """A copy of the current affines."""
        return Exposure(self.frame_ids.copy(), self.affines.copy())

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all numbers that change, by name, for a checkpoint."""
        return {"affines": self.affines, "first": self.first, "second": self.second, "steps": self.steps}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Continue from the result of `arrays`."""
        self.affines, self.first = arrays["affines"], arrays["first"]
        self.second, self.steps = arrays["second"], arrays["steps"]

    def affine(self, frame_id: int) -> Tensor:
        """Return the affine of a frame, [3, 4] float32."""
        return torch.from_numpy(self.affines[self._index[frame_id]].astype(np.float32))

    def step(self, frame_id: int, gradient: NDArray[np.float64]) -> None:
        """Do one step of Adam on a frame's affine, along ``gradient`` [3, 4]."""
        i = self._index[frame_id]
        self.steps[i] += 1
        self.first[i] += 0.1 * (gradient - self.first[i])
        self.second[i] += 0.001 * (gradient * gradient - self.second[i])
        first = self.first[i] / (1.0 - 0.9 ** int(self.steps[i]))
        second = self.second[i] / (1.0 - 0.999 ** int(self.steps[i]))
        self.affines[i] -= self._rate * first / (np.sqrt(second) + 1e-15)
        self.affines = centred(self.affines, self._weights)
