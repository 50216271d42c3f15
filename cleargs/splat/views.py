"""What a training looks at: views (a camera, an image, a weight) and the bounded cache of their images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.errors import InputError, StageError
from cleargs.random_streams import Stream
from cleargs.splat.camera import Camera
from cleargs.types import AnyImage, MaskBool

UNSEEN_BLOCK, UNSEEN_CELL = 8, 80
"""Side in pixels of the blocks of a frame that no training sees, and of the cells that have one each: 1 %."""


@dataclass(frozen=True, eq=False)
class TrainingView:
    """One image that a scene should explain."""

    frame_id: int
    camera: Camera
    weight: float
    """Factor on the loss: the RVA weight w_i of a real frame."""
    kind: Literal["real", "pseudo"]
    """A captured frame, or a repaired one."""
    load: Callable[[], tuple[AnyImage, MaskBool | None]]
    """Gives image [H, W, 3] (uint8, or float32 sRGB in [0, 1]) and mask [H, W] (True counts; None: all do).
    Called when first needed, and again when the cache could not keep the image."""


def require_views(views: Sequence[TrainingView]) -> None:
    """Raise InputError when there is nothing to train on."""
    if not views:
        raise InputError(
            "no frame is left to train on: every weight is 0",
            hint="lower rva.tau_R, or use every frame with --set rva.enabled=false",
        )


def unseen_pixels(frame_id: int, height: int, width: int) -> MaskBool:
    """The pixels [H, W] of a frame, and of its repairs, that no training sees; they follow from ``frame_id``.

    How well a scene shows them says how good it is without a frame held out. They lie in blocks, since a
    pixel alone is known from its neighbours. An image of less than two blocks a side has none.
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
    """Decoded images within a limit of bytes, at one scale at a time.

    For a training (``training``) the masks leave out the `unseen_pixels`.

    An image is held as it was loaded (uint8), or as half floats where it was float32, and always passes
    through that form, so that results do not depend on what fitted. What fits first stays: under the
    trainer's shuffled epochs dropping the oldest would only lower the share of hits. Images lie on
    ``device``.
    """

    def __init__(
        self, limit_bytes: int, device: torch.device | str = "cpu", *, training: bool = False
    ) -> None:
        self._limit = limit_bytes
        self._training = training
        self._device = torch.device(device)
        # A tensor, since a GPU multiplies by the reciprocal of a number, which is not the same.
        self._white = torch.tensor(255.0, device=self._device)
        self._used = 0
        self._factor = 1.0
        self._held: dict[TrainingView, tuple[Tensor, Tensor | None]] = {}
        self._scratch: dict[tuple[int, int], Tensor] = {}

    def get(self, view: TrainingView, factor: float = 1.0) -> tuple[Tensor, Tensor | None]:
        """Image [H, W, 3] float32 and mask [H, W] (or None) of a view, resampled by ``factor``.

        The image lies in a buffer of the cache, and is valid until the next call.
        """
        if factor != self._factor:
            self._held.clear()
            self._used, self._factor = 0, factor
        entry = self._held.get(view)
        if entry is None:
            pixels, counts = _prepare(view, factor, self._training)
            entry = (
                torch.from_numpy(pixels).to(self._device),
                None if counts is None else torch.from_numpy(counts).to(self._device),
            )
            size = pixels.nbytes + (0 if counts is None else counts.nbytes)
            if self._used + size <= self._limit:
                self._held[view] = entry
                self._used += size
        stored, mask = entry
        height, width = stored.shape[:2]
        if (height, width) not in self._scratch:
            self._scratch[height, width] = torch.empty(height, width, 3, device=self._device)
        image = self._scratch[height, width].copy_(stored)
        if stored.dtype == torch.uint8:
            image /= self._white
        return image, mask


def _prepare(
    view: TrainingView, factor: float, training: bool
) -> tuple[NDArray[np.generic], MaskBool | None]:
    """Load a view and resample it by pixel area; a reduced pixel counts when every pixel under it does."""
    image, mask = view.load()
    camera = view.camera.scaled(factor)
    expected = (view.camera.height, view.camera.width)
    if image.shape != (*expected, 3) or (mask is not None and mask.shape != expected):
        raise StageError(
            f"the image of frame {view.frame_id} is {image.shape[1]}x{image.shape[0]}, "
            f"its camera {expected[1]}x{expected[0]}",
            hint="run ingest again with --force ingest",
        )
    if training and (unseen := unseen_pixels(view.frame_id, *expected)).any():
        mask = ~unseen if mask is None else mask & ~unseen
    if factor != 1.0:
        size = (camera.width, camera.height)
        if mask is not None:
            mask = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return (image if image.dtype == np.uint8 else image.astype(np.float16)), mask
