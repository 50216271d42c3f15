"""What the expert restores for a target frame: the raw frame O_t, or the render R_t where that shows more."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from cleargs.errors import StoreError
from cleargs.media.exr import LayeredImage, from_layer, read_exr, to_layer, write_exr
from cleargs.rivr.candidates import Image, Source
from cleargs.rva.blur import detail_ratios
from cleargs.rva.degradations import noise_level
from cleargs.rva.luminance import reduce_luminance
from cleargs.splat.views import Mask, View


class Restorations:
    """D_t of target frames. That of a raw frame is made when it is first asked for and kept in ``cache``."""

    def __init__(
        self,
        restore: Callable[[Image], Image],
        cache: Path,
        *,
        use_observation: bool,
        prefer_sharper: bool,
    ) -> None:
        self._restore = restore
        self._cache = cache
        self._use_observation = use_observation
        self._prefer_sharper = prefer_sharper

    def __call__(self, view: View, render: Image) -> tuple[Image, Source]:
        """D_t in the light of the render R_t, and what it was made from."""
        if not self._use_observation:
            return self._restore(render), "render"
        observed, mask = observation(view)
        if self._prefer_sharper and shows_more(render, observed, mask):
            return self._restore(render), "render"
        return self._restored_observation(view, observed), "observation"

    def _restored_observation(self, view: View, observed: Image) -> Image:
        """As the cache gives it back, so that every round and every resumed run has the same bits."""
        path = self._cache / f"{view.frame_id:06d}.exr"
        try:
            return from_layer(read_exr(path).layers["restored"])
        except StoreError:  # not made yet, or not whole
            self._cache.mkdir(exist_ok=True)
            write_exr(path, LayeredImage({"restored": to_layer(self._restore(observed))}, {}))
            return from_layer(read_exr(path).layers["restored"])


def shows_more(render: Image, observed: Image, mask: Mask | None) -> bool:
    """Whether the render has more fine detail than the raw frame of the same view.

    Both show the same content, so `rva.blur.detail_ratios`, its mean over the directions and beyond the
    noise, compares their sharpness without a reference. Only pixels that the mask lets through count.
    """
    return _detail(render, mask) > _detail(observed, mask)


def observation(view: View) -> tuple[Image, Mask | None]:
    """O_t as float32 sRGB, and its mask."""
    pixels, mask = view.load()
    if pixels.dtype == np.uint8:
        return pixels.astype(np.float32) / np.float32(255.0), mask
    return pixels.astype(np.float32), mask


def _detail(image: Image, mask: Mask | None) -> float:
    levels = np.rint(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)
    luminance = reduce_luminance(levels, None if mask is None else mask.astype(np.uint8))
    noise = noise_level(luminance.reduced, luminance.valid)
    return float(detail_ratios(luminance.reduced, luminance.valid, noise).mean())
