"""Training views (camera, image, weight), and a cache of their images with a memory limit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.errors import InputError, StageError
from cleargs.random_streams import Stream
from cleargs.splat.camera import Camera
from cleargs.types import AnyImage, ArrayF32, MaskBool, MaskU8

UNSEEN_BLOCK, UNSEEN_CELL = 8, 80
"""Side, px, of the blocks that no training sees (1 % of a frame), and of the cells with one block each."""


@dataclass(frozen=True, eq=False)
class TrainingView:
    """An image that supervises the training."""

    frame_id: int
    camera: Camera
    weight: float
    """Factor on the loss: the RVA weight w_i of a frame image."""
    kind: Literal["real", "pseudo"]
    """A frame image (real), or its repair (pseudo)."""
    load: Callable[[], tuple[AnyImage, MaskBool | None]]
    """Function that loads the image [H, W, 3] (uint8, or float32 sRGB in [0, 1]) and the mask [H, W] (True:
    the pixel counts) or None. It is called on each cache miss."""
    estimated: bool = False
    """True if the pose was estimated or adjusted; False if it is a pose of the input that fits the images."""
    time: float = math.nan
    """Capture time of the frame, s; without a clock, its number in the capture; NaN if neither is known."""
    transparency: Callable[[], MaskU8 | None] | None = None
    """Function that returns the alpha [H, W] of a cut-out, whose transparent pixels are empty; else None."""
    movers: tuple[tuple[int, int, int, int], ...] = ()
    """Boxes of what may move (left, top, right, bottom, px); see `cleargs.formation.movement`."""


class ViewDataset(torch.utils.data.Dataset[dict[str, Any]]):
    """Training views as a dataset of torch. An item is read from its image file when it is needed.

    An item is a dict: ``image`` [3, H, W] float32 sRGB in [0, 1], ``mask`` [H, W] bool (True: the pixel
    counts), ``K`` [3, 3] and ``camera_to_world`` [4, 4] float32 (OpenCV axes), ``weight`` and ``frame_id``.
    """

    def __init__(self, views: Sequence[TrainingView]) -> None:
        self._views = views

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> dict[str, Any]:
        view = self._views[index]
        camera, (pixels, mask) = view.camera, view.load()
        image = torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1)
        counts = np.ones(pixels.shape[:2], np.bool_) if mask is None else mask
        intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
        return {
            "image": image / 255.0 if image.dtype == torch.uint8 else image,
            "mask": torch.from_numpy(counts),
            "K": torch.tensor(intrinsics),
            "camera_to_world": torch.from_numpy(np.linalg.inv(camera.world_to_camera)).float(),
            "weight": view.weight,
            "frame_id": view.frame_id,
        }


def require_views(views: Sequence[TrainingView]) -> None:
    """Raise InputError if there are no views."""
    if not views:
        raise InputError(
            "there are no frames to train on: all weights are 0",
            hint="lower rva.tau_R, or use every frame with --set rva.enabled=false",
        )


def unseen_pixels(frame_id: int, height: int, width: int) -> MaskBool:
    """Return the pixels [H, W] of a frame and of its repairs that no training sees.

    They measure the quality of a scene without held-out frames. They form blocks, because the neighbours of a
    single pixel reveal its colour. The positions are random, with ``frame_id`` as seed. Images with a side of
    less than two blocks have none.
    """
    unseen = np.zeros((height, width), np.bool_)
    if min(height, width) < 2 * UNSEEN_BLOCK:
        return unseen
    rng = np.random.default_rng([Stream.UNSEEN_PIXELS, frame_id])
    rows, columns = (max(1, round(side / UNSEEN_CELL)) for side in (height, width))
    free_rows, free_columns = height / rows - UNSEEN_BLOCK, width / columns - UNSEEN_BLOCK
    for row in range(rows):
        for column in range(columns):
            down, right = rng.random(2)
            y = int(row * height / rows + down * free_rows)
            x = int(column * width / columns + right * free_columns)
            unseen[y : y + UNSEEN_BLOCK, x : x + UNSEEN_BLOCK] = True
    return unseen


class ImageCache:
    """Cache of decoded images, with a limit of their memory in bytes, at one scale at a time.

    Images are stored as uint8, or as float16 if they were float32. Images that do not fit are also converted
    to these types, so that results do not depend on the limit. A stored image stays: replacing the oldest one
    would reduce the hit rate in shuffled epochs. With ``training``, masks exclude the `unseen_pixels`.
    """

    def __init__(
        self, limit_bytes: int, device: torch.device | str = "cpu", *, training: bool = False
    ) -> None:
        self._limit = limit_bytes
        self._training = training
        self._device = torch.device(device)
        # A tensor: a GPU divides by a number by multiplying with its reciprocal, which rounds differently.
        self._white = torch.tensor(255.0, device=self._device)
        self._used = 0
        self._factor = 1.0
        self._images: dict[TrainingView, tuple[Tensor, Tensor | None, Tensor | None]] = {}
        self.alpha: Tensor | None = None
        """Alpha [H, W] of the last image in a training, which is then multiplied by it; else None."""
        self._scratch: dict[tuple[int, int], Tensor] = {}

    def get(self, view: TrainingView, factor: float = 1.0) -> tuple[Tensor, Tensor | None]:
        """Return image [H, W, 3] float32 sRGB and mask [H, W] or None of a view, resampled by ``factor``.

        The image is a buffer of the cache, valid until the next call.
        """
        if factor != self._factor:
            self._images.clear()
            self._used, self._factor = 0, factor
        entry = self._images.get(view)
        if entry is None:
            pixels, counts, alpha = _prepare(view, factor, self._training)
            entry = (
                torch.from_numpy(pixels).to(self._device),
                None if counts is None else torch.from_numpy(counts).to(self._device),
                None if alpha is None else torch.from_numpy(alpha).to(self._device),
            )
            size = sum(array.nbytes for array in (pixels, counts, alpha) if array is not None)
            if self._used + size <= self._limit:
                self._images[view] = entry
                self._used += size
        stored, mask, self.alpha = entry
        height, width = stored.shape[:2]
        if (height, width) not in self._scratch:
            self._scratch[height, width] = torch.empty(height, width, 3, device=self._device)
        image = self._scratch[height, width]
        if stored.dtype == torch.uint8:
            return torch.div(stored, self._white, out=image), mask
        return image.copy_(stored), mask


def _prepare(
    view: TrainingView, factor: float, training: bool
) -> tuple[NDArray[np.generic], MaskBool | None, ArrayF32 | None]:
    """Load a view and resample it by pixel area; a reduced pixel counts if all pixels under it count.

    The third array is the alpha of a cut-out in a training, whose empty pixels count.
    """
    image, mask = view.load()
    levels = view.transparency() if training and view.transparency is not None else None
    alpha = None if levels is None else levels.astype(np.float32) / np.float32(255)
    if alpha is not None:
        image = (image * alpha[..., None]).round().astype(image.dtype)
        mask = None if mask is None else mask | (alpha <= 0.5)
    camera = view.camera.scaled(factor)
    expected = (view.camera.height, view.camera.width)
    if image.shape != (*expected, 3) or (mask is not None and mask.shape != expected):
        raise StageError(
            f"the image of frame {view.frame_id} has {image.shape[1]}x{image.shape[0]} pixels, "
            f"but its camera has {expected[1]}x{expected[0]}",
            hint="repeat ingest with --force ingest",
        )
    if training and (unseen := unseen_pixels(view.frame_id, *expected)).any():
        mask = ~unseen if mask is None else mask & ~unseen
    if factor != 1.0:
        size = (camera.width, camera.height)
        if mask is not None:
            mask = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if alpha is not None:
            alpha = np.asarray(cv2.resize(alpha, size, interpolation=cv2.INTER_AREA), np.float32)
    return (image if image.dtype == np.uint8 else image.astype(np.float16)), mask, alpha
