"""Movement in a capture: regions of a frame that the scene of the other frames does not explain.

Each frame has a grid of cells. A cell moves if all of the following are true:

- Its mean colour differs from that of the render as the frame's camera saw it. Detail that is missing, or a
  little out of place, cancels out over a cell.
- The difference exceeds five times the median of the frame, so that nothing moves in a frame that differs
  everywhere, as with an unknown exposure.
- At least three other frames see the same place of the scene, and the median of their differences there is
  below a fifth of the cell's difference. Content that most frames show at a place does not move.
- The place moves in at most half of the eight nearest frames that see it.
- It belongs to a region of at least sixteen cells.

In the box of a person, an animal, a vehicle or a screen, half of the difference suffices, the other frames
may have twice the share of it, and a region may have any size.

Sources: Sabour et al., "RobustNeRF" (2023), for the trimmed residual on neighbourhoods; the comparison with
the other frames at the same place is ours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.parquet import column, read_table, write_table
from cleargs.splat.camera import Camera
from cleargs.splat.types import Render
from cleargs.types import ArrayF32, ArrayF64, MaskBool

TOLERANCE = 0.1
"""Difference of mean colours, sRGB in [0, 1], up to which nothing moves."""
HIDING = 0.3
"""RVA's ghosting cue of a frame from which the training looks for movement (docs/movement.md)."""
CELLS = 64
"""Cells along the longer side of a frame."""
MEDIAN_FACTOR = 5.0
"""Multiple of the frame's median difference up to which a difference is ordinary."""
OTHERS_FACTOR = 0.2
"""A cell can move if the median difference of the other frames is below this share of its difference."""
MIN_OTHERS = 3
"""Fewest other frames that see a place where something can move."""
NEAR_FRAMES, MAX_NEAR_SHARE = 8, 0.5
"""Number of nearest frames, by camera, that see a place, and the largest share of them in which it may move.
If it moves in more, something that does not move was masked by mistake. It was then not learned, so it
differs from the render."""
MIN_CELLS = 16
"""Fewest cells of a region that moves."""
LIKELY = 2.0
"""Factor by which evidence may be weaker in the box of something that may move; its regions may be small."""
EVERY = 3
"""Steps on a frame between two checks (comparisons that update the cells that move)."""
START = 0.25
"""Share of the schedule from which movement is looked for."""

Boxes = Sequence[tuple[int, int, int, int]]
"""Left, top, right and bottom, px."""

MOVEMENT = pa.schema(
    [
        column("frame_id", pa.int32(), "frame in which something moves"),
        column("moving_share", pa.float64(), "share of its cells that move"),
        column("rows", pa.int32(), "rows of cells, which divide the frame evenly"),
        column("columns", pa.int32(), "columns of cells"),
        column("moves", pa.binary(), "a bit per cell, row by row, highest bit first; 1: the cell moves"),
    ]
)
"""``movement.parquet``: the masks that a training used at its end. In other frames nothing moves."""


class Movement:
    """Movement in the frames of a capture, found while a scene is trained."""

    def __init__(
        self,
        cameras: Mapping[int, Camera],  # by frame_id, at full size
        tolerance: float,  # difference of mean colours, sRGB in [0, 1], up to which nothing moves; 0: never
        known: Mapping[int, MaskBool] | None = None,  # [rows, columns] cells that an earlier training found
        likely: Mapping[int, Boxes] | None = None,  # px of the camera: something that may move is seen there
    ) -> None:
        self._tolerance = tolerance
        self._place = {frame_id: k for k, frame_id in enumerate(cameras)}
        self._cameras = list(cameras.values())
        first = self._cameras[0] if self._cameras else Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4))
        per_pixel = CELLS / max(first.width, first.height)
        shape = max(1, round(per_pixel * first.height)), max(1, round(per_pixel * first.width))
        self._differences: ArrayF32 = np.full((len(cameras), *shape), np.inf, np.float32)  # unknown so far
        self._moves: MaskBool = np.zeros((len(cameras), *shape), np.bool_)
        self._likely: MaskBool = np.zeros_like(self._moves)
        for frame_id, boxes in (likely or {}).items():
            place = self._place[frame_id]
            camera = self._cameras[place]
            for left, top, right, bottom in boxes:
                down = slice(top * shape[0] // camera.height, -(-bottom * shape[0] // camera.height))
                across = slice(left * shape[1] // camera.width, -(-right * shape[1] // camera.width))
                self._likely[place, down, across] = True
        for frame_id, cells in (known or {}).items():
            if frame_id in self._place and cells.shape == shape:
                self._moves[self._place[frame_id]] = cells
        self._to_camera = np.array([camera.world_to_camera for camera in self._cameras]).reshape(-1, 4, 4)
        self._centres = np.array([camera.centre for camera in self._cameras]).reshape(-1, 3)
        self._lenses = np.array(
            [(c.fx / c.width, c.fy / c.height, c.cx / c.width, c.cy / c.height) for c in self._cameras]
        ).reshape(-1, 4)

    def due(self, visits: int, progress: float) -> bool:
        """Return True if a step on a frame, after ``visits`` earlier ones, includes a check."""
        return self._tolerance > 0.0 and progress >= START and visits % EVERY == 0

    def masks(self) -> dict[int, MaskBool]:
        """Return the cells that move [rows, columns], by frame_id, for frames in which something moves."""
        return {frame_id: self._moves[k] for frame_id, k in self._place.items() if self._moves[k].any()}

    def check(
        self,
        frame_id: int,
        image: Tensor,  # [H, W, 3] sRGB, the render as the frame's camera saw it
        render: Render,  # sharp, with depth
        margin: int,  # pixels by which ``render`` is larger on every side
        observed: Tensor,  # [H, W, 3] sRGB
        mask: Tensor | None,  # [H, W] pixels that count by the user's mask
    ) -> None:
        """Compare a frame, ``observed``, with the scene, and update the cells that move in it."""
        k, (height, width) = self._place[frame_id], image.shape[:2]
        assert render.depth is not None
        inner = slice(margin, margin + height), slice(margin, margin + width)
        counted = np.ones((height, width), np.float32) if mask is None else mask.float().cpu().numpy()
        difference = (image - observed).cpu().numpy() * counted[..., None]
        shares, alpha = self._pooled(counted), self._pooled(render.alpha[inner].cpu().numpy())
        known = (shares > 0.25) & (alpha > 0.5)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = np.abs(self._pooled(difference) / shares[..., None]).mean(axis=2)
            depth = self._pooled(render.depth[inner].cpu().numpy()) / alpha
        self._differences[k] = np.where(known, found, np.inf)
        ordinary = (
            max(self._tolerance, MEDIAN_FACTOR * float(np.median(found[known]))) if known.any() else 1.0
        )
        likely = self._likely[k]
        least = np.where(likely, ordinary / LIKELY, ordinary)
        asked = (known & (found > least)) | self._moves[k]
        if not asked.any():
            return
        rows, columns = np.nonzero(asked)
        others, witnesses, near = self._elsewhere(k, rows, columns, np.where(known, depth, 1.0)[asked])
        mine = self._differences[k, rows, columns]
        moves, unwitnessed = np.zeros_like(asked), np.zeros_like(asked)
        most = np.where(likely[asked], LIKELY * OTHERS_FACTOR, OTHERS_FACTOR) * mine
        moves[asked] = (mine > least[asked]) & (others < most) & (witnesses >= MIN_OTHERS)
        moves[asked] &= near <= MAX_NEAR_SHARE
        moves &= known
        unwitnessed[asked] = witnesses < MIN_OTHERS
        self._moves[k] = regions(moves, likely) | (self._moves[k] & unwitnessed)  # these stay as they were

    def static_mask(self, frame_id: int, mask: Tensor | None, observed: Tensor) -> Tensor | None:
        """Return the pixels of a frame that count: see `counted`."""
        k = self._place.get(frame_id)
        return counted(mask, None if k is None or not self._moves[k].any() else self._moves[k], observed)

    def state(self) -> dict[str, Tensor]:
        """Return everything that the training changes, for a checkpoint."""
        return {
            "movement.differences": torch.from_numpy(self._differences.copy()),
            "movement.moves": torch.from_numpy(self._moves.copy()),
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Continue from the result of `state`."""
        self._differences = state["movement.differences"].numpy().copy()
        self._moves = state["movement.moves"].numpy().copy()

    def _pooled(self, image: ArrayF32) -> ArrayF32:
        """Return the mean of ``image`` [H, W, ...] over each cell."""
        rows, columns = self._moves.shape[1:]
        return np.asarray(cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA))

    def _elsewhere(
        self, k: int, row: NDArray[np.intp], column: NDArray[np.intp], depth: ArrayF32
    ) -> tuple[ArrayF32, NDArray[np.int64], ArrayF64]:
        """Return the differences of other frames at the places that C cells of frame ``k`` show at ``depth``.

        These are three arrays [C]: the median of the differences, infinite if no other frame sees the place;
        the number of checked frames that see it; and the share of the `NEAR_FRAMES` of these with the nearest
        cameras in which it moves.
        """
        rows, columns = self._moves.shape[1:]
        fx, fy, cx, cy = self._lenses[k]
        x, y = ((column + 0.5) / columns - cx) / fx * depth, ((row + 0.5) / rows - cy) / fy * depth
        points = np.stack([x, y, depth, np.ones_like(depth)], axis=-1)
        between = np.einsum("fij,jk->fik", self._to_camera, np.linalg.inv(self._to_camera[k]))
        x, y, z, _ = np.moveaxis(np.einsum("fij,cj->fci", between, points), 2, 0)  # [F, C] each
        ahead = np.maximum(z, 1e-6)
        fx, fy, cx, cy = (numbers[:, None] for numbers in self._lenses.T)
        column_there = np.floor((x / ahead * fx + cx) * columns)
        row_there = np.floor((y / ahead * fy + cy) * rows)
        inside = (z > 1e-3) & (column_there >= 0) & (column_there < columns)
        inside &= (row_there >= 0) & (row_there < rows)
        inside[k] = False
        cells = (
            np.arange(len(inside))[:, None],
            *(np.where(inside, place, 0).astype(np.intp) for place in (row_there, column_there)),
        )
        there = np.where(inside, self._differences[cells], np.inf)
        seen = np.isfinite(there)
        witnesses = seen.sum(axis=0)
        middle = np.maximum(witnesses - 1, 0)[None] // 2
        order = np.argsort(np.square(self._centres - self._centres[k]).sum(axis=1), kind="stable")
        near = seen[order] & (np.cumsum(seen[order], axis=0) <= NEAR_FRAMES)
        share = (self._moves[cells][order] & near).sum(axis=0) / np.maximum(near.sum(axis=0), 1)
        return np.take_along_axis(np.sort(there, axis=0), middle, axis=0)[0], witnesses, share


def regions(cells: MaskBool, likely: MaskBool | None = None) -> MaskBool:  # [rows, columns] each
    """Return the regions of at least `MIN_CELLS` cells, with gaps closed and a border of one cell added.

    A region with a cell of ``likely`` may be smaller.
    """
    closed = cv2.morphologyEx(cells.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= MIN_CELLS
    if likely is not None:
        large[labels[(closed > 0) & likely]] = True
    large[0] = False  # the background
    return np.asarray(cv2.dilate(large[labels].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def counted(mask: Tensor | None, moves: MaskBool | None, observed: Tensor) -> Tensor | None:
    """Return the pixels [H, W] of ``mask`` in which nothing moves; None: all of ``observed`` [H, W, 3]."""
    if moves is None:
        return mask
    counts = torch.from_numpy(static_pixels(moves, observed.shape[0], observed.shape[1])).to(observed.device)
    return counts if mask is None else counts & mask


def static_pixels(moves: MaskBool, height: int, width: int) -> MaskBool:
    """Return the pixels [height, width] that are in no cell of ``moves`` [rows, columns]."""
    rows = np.arange(height) * moves.shape[0] // height
    columns = np.arange(width) * moves.shape[1] // width
    return np.asarray(~moves[rows[:, None], columns])


def write_movement(path: Path, masks: Mapping[int, MaskBool]) -> None:
    """Write ``movement.parquet``."""
    rows = [
        {
            "frame_id": frame_id,
            "moving_share": float(cells.mean()),
            "rows": cells.shape[0],
            "columns": cells.shape[1],
            "moves": np.packbits(cells).tobytes(),
        }
        for frame_id, cells in masks.items()
    ]
    write_table(path, pa.Table.from_pylist(rows, MOVEMENT), MOVEMENT)


def read_movement(path: Path) -> dict[int, MaskBool]:
    """Read ``movement.parquet``: the cells that move [rows, columns], by frame_id.

    Raises StoreError if it is missing or damaged.
    """
    found = {}
    for row in read_table(path, MOVEMENT).to_pylist():
        shape = row["rows"], row["columns"]
        bits = np.unpackbits(np.frombuffer(row["moves"], np.uint8), count=shape[0] * shape[1])
        found[row["frame_id"]] = bits.reshape(shape).astype(np.bool_)
    return found
