"""From a lens to a pinhole: the published images have no distortion and no empty pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.capture.cameras import Intrinsics, pinhole
from cleargs.errors import InputError
from cleargs.media.image import reduced, reduced_size
from cleargs.types import ImageU8, MaskU8, PlaneF32

MAX_TANGENT = 1.75
"""A pinhole image reaches at most 60 degrees off its axis: fisheye images are cropped there."""

HARDLY_REDUCED = 1.25
"""Reduction up to which an image is resampled once, at its published size. Area averaging after the first
resampling would average two neighbours at some places, and stripes of 4 px would lose a third of their
contrast."""

_EDGE_SAMPLES, _BOX_SAMPLES = 256, 9


@dataclass(frozen=True)
class Undistorter:
    """Map from one camera's images to those of a pinhole."""

    pinhole: Intrinsics
    """Camera of the published image."""
    _lens: Intrinsics
    _map: tuple[PlaneF32, PlaneF32] | None
    """Position in the lens's image of each pixel of the flat image, which is then reduced to the published
    size unless it has it (`HARDLY_REDUCED`); None without distortion."""

    def image(self, rgb: ImageU8) -> ImageU8:  # [H, W, 3]
        """Return the published image: bicubic into the flat image, then area averaging, in sRGB."""
        if self._map is not None:
            rgb = np.asarray(cv2.remap(rgb, *self._map, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))
        return reduced(rgb, max(self.pinhole.width, self.pinhole.height))

    def mask(self, mask: MaskU8) -> MaskU8:  # [H, W]
        """Return the published mask, by nearest pixels."""
        if self._map is not None:
            mask = np.asarray(cv2.remap(mask, *self._map, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE))
        size = (self.pinhole.width, self.pinhole.height)
        return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST))

    def points(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:  # [K, 2]
        """Map pixel positions in the image of the lens to positions in the published image.

        Positions that a fisheye sees at 90 degrees or more off its axis are NaN: no flat image shows them.
        """
        return np.asarray(_tangents(self._lens, xy) * self.pinhole.focal + np.array(self.pinhole.centre))

    def box(self, corners: tuple[int, int, int, int]) -> dict[str, int]:
        """Map a box (left, top, right, bottom, px) to the published image, by its outline."""
        left, top, right, bottom = corners
        across, down = np.linspace(left, right, _BOX_SAMPLES), np.linspace(top, bottom, _BOX_SAMPLES)
        ends = np.concatenate([np.full_like(across, end) for end in (top, bottom)])
        sides = np.concatenate([np.full_like(down, side) for side in (left, right)])
        x, y = np.concatenate([np.tile(across, 2), sides]), np.concatenate([ends, np.tile(down, 2)])
        xy = self.points(np.stack([x, y], axis=1))
        size = np.array([self.pinhole.width, self.pinhole.height])
        low, high = (np.clip(end(xy, axis=0), 0, size) for end in (np.nanmin, np.nanmax))
        sides_px = (*np.floor(low), *np.ceil(high))
        return dict(zip(("left", "top", "right", "bottom"), map(int, sides_px), strict=True))

    def inside(self, xy: NDArray[np.float64]) -> NDArray[np.bool_]:  # [K, 2]
        """Return True for each position inside the published image."""
        size = np.array([self.pinhole.width, self.pinhole.height])
        return np.asarray(((xy >= 0) & (xy < size)).all(axis=1))


def undistorter(lens: Intrinsics, max_size: int) -> Undistorter:
    """Prepare the undistortion of a camera's images to a long side of at most ``max_size`` px.

    The pinhole keeps the lens's focal lengths. It shows the largest rectangle around the axis that the lens's
    image covers wholly, as COLMAP's undistorter does without blank pixels. InputError is raised if the
    distortion leaves no such rectangle.
    """
    if lens.is_pinhole:
        flat = pinhole(lens.width, lens.height, *lens.focal, *lens.centre)
        return Undistorter(flat.resized(*reduced_size(flat.width, flat.height, max_size)), lens, None)
    left, top, right, bottom = _covered(lens)
    fx, fy = lens.focal
    width, height = int((right - left) * fx), int((bottom - top) * fy)
    if width < 16 or height < 16:
        raise InputError(
            f"the {lens.model} camera's distortion leaves nothing of its images",
            hint="check k1..k4, p1, p2, or set ingest.poses=sfm to find another camera",
        )
    flat = pinhole(width, height, fx, fy, -left * fx, -top * fy)
    published = flat.resized(*reduced_size(width, height, max_size))
    sampled = published if max(width, height) <= HARDLY_REDUCED * max_size else flat
    x = (np.arange(sampled.width) + 0.5 - sampled.centre[0]) / sampled.focal[0]
    y = (np.arange(sampled.height) + 0.5 - sampled.centre[1]) / sampled.focal[1]
    shape = sampled.height, sampled.width
    rays = np.stack([*np.meshgrid(x, y), np.ones(shape)], axis=-1)
    # OpenCV puts the centre of the first pixel at 0, COLMAP at 0.5.
    where = lens.colmap().img_from_cam(rays.reshape(-1, 3)).reshape(*shape, 2).astype(np.float32) - 0.5
    maps = np.ascontiguousarray(where[..., 0]), np.ascontiguousarray(where[..., 1])
    return Undistorter(published, lens, maps)


def _tangents(lens: Intrinsics, xy: NDArray[np.float64]) -> NDArray[np.float64]:  # [K, 2]
    """Return x / z and y / z of the rays of pixels [K, 2]; NaN where a fisheye looks to the side or back."""
    camera = lens.colmap()
    rays = np.array(camera.cam_from_img(np.ascontiguousarray(xy)), np.float64)
    if lens.is_fisheye:
        # From 90 degrees on COLMAP returns finite rays of other directions, which lead to other pixels.
        again = np.asarray(camera.img_from_cam(np.c_[rays, np.ones(len(rays))]))
        rays[~(np.abs(again - xy) < 1).all(axis=1)] = np.nan
    return rays


def _covered(lens: Intrinsics) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom (tangents) of the rectangle that the lens's image covers wholly."""
    t = np.linspace(0, 1, _EDGE_SAMPLES)
    zero, one = np.zeros_like(t), np.ones_like(t)
    size = np.array([lens.width, lens.height])

    def edge(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        rays = _tangents(lens, np.stack([x, y], axis=1) * size)
        return rays[np.isfinite(rays).all(axis=1)]

    first = (edge(zero, t)[:, 0], edge(t, zero)[:, 1])
    last = (edge(one, t)[:, 0], edge(t, one)[:, 1])
    left, top = (float(tangents.max(initial=-MAX_TANGENT)) for tangents in first)
    right, bottom = (float(tangents.min(initial=MAX_TANGENT)) for tangents in last)
    return left, top, right, bottom
