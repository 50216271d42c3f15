"""Exposure compensation: one affine on sRGB per frame, learned beside the scene where a capture needs it.

The pixel operations are `cleargs.splat.exposure`; here are the affines themselves. They start from the gains
that the sparse points show. Their median, weighted as the frames are, stays the identity: scene and affines
cannot drift apart together, and a few badly exposed frames do not make the scene darker or brighter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cleargs.splat.initialise import SparsePoints
from cleargs.splat.tables import EXPOSURE
from cleargs.splat.views import View
from cleargs.tables import read_table, write_table

IDENTITY = np.eye(3, 4)
"""The affine that changes nothing, [3, 4]: matrix and offset."""

MIN_POINTS = 20
"""Fewest sparse points from which a frame's gain is measured."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """The affine of every frame: shown colour = affine[:, :3] @ scene colour + affine[:, 3]."""

    frame_ids: NDArray[np.int32]  # [F] ascending
    affines: NDArray[np.float64]  # [F, 3, 4]

    @classmethod
    def identity(cls, frame_ids: Sequence[int]) -> Exposure:
        """Exposure that changes nothing yet, for these frames."""
        unique = np.unique(np.asarray(frame_ids, np.int32))
        return cls(unique, np.tile(IDENTITY, (len(unique), 1, 1)))

    @classmethod
    def from_gains(cls, frame_ids: Sequence[int], gains: NDArray[np.float64]) -> Exposure:
        """Exposure that brightens each of these distinct frames by its gain (NaN: not at all) over the median
        one."""
        known = gains[np.isfinite(gains)]
        relative = gains / np.median(known) if len(known) else gains
        order = np.argsort(np.asarray(frame_ids))
        start = np.where(np.isfinite(relative), relative, 1.0)[order, None, None] * IDENTITY
        return cls(np.asarray(frame_ids, np.int32)[order], start)

    @property
    def enabled(self) -> bool:
        """Whether any affine differs from the identity."""
        return bool((self.affines != IDENTITY).any())

    def of(self, frame_id: int) -> NDArray[np.float64]:
        """The affine [3, 4] of a frame; the identity where it has none."""
        index = np.flatnonzero(self.frame_ids == frame_id)
        return self.affines[index[0]] if len(index) else IDENTITY


def centred(affines: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """The affines [F, 3, 4] shifted so that the (lower) median of each entry, weighted by ``weights`` [F], is
    the identity's."""
    total = weights.sum()
    if total <= 0.0:
        return affines
    order = np.argsort(affines, axis=0, kind="stable")
    middle = (np.cumsum(weights[order], axis=0) >= 0.5 * total).argmax(axis=0)[None]
    median = np.take_along_axis(affines, np.take_along_axis(order, middle, axis=0), axis=0)
    return np.asarray(affines - (median - IDENTITY), np.float64)


def frame_gains(views: Sequence[View], sparse: SparsePoints) -> NDArray[np.float64]:
    """How much brighter than average each view shows the sparse points: gains [V], NaN where unknown.

    The median, over the points that a view observes, of its pixel at the point's projection over the point's
    own colour (sums of sRGB).
    """
    gains = np.full(len(views), np.nan)
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
        shown = image[rows, columns].astype(np.float64).sum(axis=1) * (
            1.0 if image.dtype == np.uint8 else 255.0
        )
        mean = sparse.rgb[seen][inside].astype(np.float64).sum(axis=1)
        usable = (mean > 30.0) & (mean < 735.0)  # near black and white a ratio says nothing about exposure
        if mask is not None:
            usable &= mask[rows, columns]
        if usable.sum() >= MIN_POINTS:
            gains[index] = np.median(shown[usable] / mean[usable])
    return gains


def gain_spread(gains: NDArray[np.float64]) -> float:
    """Standard deviation of the log gains that are known (0.05: about 5 %); 0 with fewer than two."""
    known = np.log(np.maximum(gains[np.isfinite(gains)], 1e-3))
    return float(known.std()) if len(known) > 1 else 0.0


def write_exposure(path: Path, exposure: Exposure) -> None:
    """Write ``exposure.parquet``."""
    columns = {f"a{i}{j}": exposure.affines[:, i, j] for i in range(3) for j in range(4)}
    write_table(path, pa.table({"frame_id": exposure.frame_ids, **columns}), EXPOSURE)


def read_exposure(path: Path) -> Exposure:
    """Read ``exposure.parquet``. Raises StoreError when it is missing or damaged."""
    table = read_table(path, EXPOSURE)
    affines = np.stack([table.column(name).to_numpy() for name in EXPOSURE.names[1:]], axis=1)
    return Exposure(table.column("frame_id").to_numpy(), affines.reshape(-1, 3, 4))
