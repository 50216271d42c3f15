"""What the expert restores for a target frame: the raw frame O_t, with or without the camera's motion, or the
render R_t."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cleargs.errors import StoreError
from cleargs.media.exr import LayeredImage, from_layer, read_exr, to_layer, write_exr
from cleargs.rivr.candidates import Image, Source
from cleargs.rivr.motion.undo import Deblurred, deblur
from cleargs.splat.views import Mask, View


@dataclass(frozen=True, eq=False)
class Restoration:
    """D_t, and what it was made from."""

    image: Image
    source: Source
    deblurred: Deblurred | None = None
    """Where that is the source."""


class Restorations:
    """D_t of target frames. That of a raw frame is made when it is first asked for and kept in ``cache``."""

    def __init__(
        self, restore: Callable[[Image], Image], cache: Path, *, use_observation: bool, undo_motion: bool
    ) -> None:
        self._restore = restore
        self._cache = cache
        self._use_observation = use_observation
        self._undo_motion = undo_motion

    def __call__(
        self, view: View, render: Image, depth_of: Callable[[View], NDArray[np.float32]]
    ) -> Restoration:
        """D_t in the light of the render R_t and of the scene's depth."""
        if not self._use_observation:
            return Restoration(self._restore(render), "render")
        observed, mask = observation(view)
        if not self._undo_motion:
            return Restoration(self._restored_observation(view, observed), "observation")
        deblurred = deblur(render, observed, mask, view.camera, depth_of(view))
        return Restoration(self._restore(deblurred.image), "deblurred", deblurred)

    def _restored_observation(self, view: View, observed: Image) -> Image:
        """As the cache gives it back, so that every round and every resumed run has the same bits."""
        path = self._cache / f"{view.frame_id:06d}.exr"
        try:
            return from_layer(read_exr(path).layers["restored"])
        except StoreError:  # not made yet, or not whole
            self._cache.mkdir(exist_ok=True)
            write_exr(path, LayeredImage({"restored": to_layer(self._restore(observed))}, {}))
            return from_layer(read_exr(path).layers["restored"])


def observation(view: View) -> tuple[Image, Mask | None]:
    """O_t as float32 sRGB, and its mask."""
    pixels, mask = view.load()
    if pixels.dtype == np.uint8:
        return pixels.astype(np.float32) / np.float32(255.0), mask
    return pixels.astype(np.float32), mask
