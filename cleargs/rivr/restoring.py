"""What the expert restores for a target frame: the raw frame O_t, with or without the camera's motion, or the
render R_t."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cleargs.errors import StoreError
from cleargs.formation.frame import FrameFormation
from cleargs.media.exr import LayeredImage, from_layer, read_exr, to_layer, write_exr
from cleargs.rivr.candidates import Image, Source
from cleargs.splat.views import Mask, View


@dataclass(frozen=True, eq=False)
class Deblurred:
    """A raw frame without what its camera did to it."""

    image: Image
    """[H, W, 3] sRGB in [0, 1], at the frame's pose."""
    formation: FrameFormation
    """What was undone."""


@dataclass(frozen=True, eq=False)
class Explained:
    """A raw frame as the training explains it."""

    image: Image
    """The render as the frame's camera saw it, [H, W, 3] sRGB in [0, 1]."""
    formation: FrameFormation
    weight: float
    """The frame's weight at the end of the training: RVA's, or what it has earned by being explained."""


@dataclass(frozen=True, eq=False)
class Restoration:
    """D_t, and what it was made from."""

    image: Image
    source: Source
    deblurred: Deblurred | None = None
    """The raw frame without its motion, where that is the source."""


class Restorations:
    """D_t of target frames. That of a raw frame is made when it is first asked for and kept in ``cache``."""

    def __init__(
        self, restore: Callable[[Image], Image], cache: Path, *, use_observation: bool, undo_motion: bool
    ) -> None:
        self._restore = restore
        self._cache = cache
        self._use_observation = use_observation
        self._undo_motion = undo_motion

    def __call__(self, view: View, render: Image, deblur: Callable[[View], Deblurred | None]) -> Restoration:
        """D_t in the light of the render R_t; ``deblur`` undoes what the scene says of the frame's camera."""
        if not self._use_observation:
            return Restoration(self._restore(render), "render")
        deblurred = deblur(view) if self._undo_motion else None
        if deblurred is None:
            return Restoration(self._restored_observation(view, observation(view)[0]), "observation")
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
