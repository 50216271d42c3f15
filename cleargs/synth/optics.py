"""Lens, shutter and aperture of a camera, and the protocol of worlds that it can film.

Poses are camera to world [3, 4] with OpenCV axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.types import ArrayF64

MIN_SAMPLES = 8
"""Samples per image without motion. More than one is needed for anti-aliasing in a ray caster."""
FIELD_OF_VIEW = math.radians(65)
"""Field of view of the longer side, as of a phone's main camera."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels; pixel centres are at + 0.5."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    fisheye: bool = False
    """True: equidistant, the distance from the principal point is the angle off the axis times fx."""

    def zoomed(self, factor: float) -> Lens:
        """Return the lens with ``factor`` times the focal lengths."""
        return replace(self, fx=factor * self.fx, fy=factor * self.fy)


def phone_lens(width: int, height: int) -> Lens:
    """Return the lens of a phone's main camera."""
    focal = max(width, height) / 2 / math.tan(FIELD_OF_VIEW / 2)
    return Lens(width, height, focal, focal, width / 2, height / 2)


LENSES = ("phone", "zoom", "switch", "breathing", "fisheye")
"""Lenses of `lens_at`."""
ZOOM, BREATHING, FISHEYE_VIEW = 1.8, 0.015, math.radians(122)
"""Largest factor of the focal length; amplitude of a focal length that breathes with the focus; field of view
of a fisheye across the longer side."""


def lens_at(kind: str, first: Lens, share: float) -> Lens:
    """Return the lens of ``kind`` at a ``share`` in [0, 1] of a capture that starts with the lens ``first``.

    zoom: the focal length grows to `ZOOM` times the first. switch: it jumps there halfway. breathing: it
    swings three times by `BREATHING`. fisheye: another lens, which does not change.
    """
    if kind == "fisheye":
        focal = max(first.width, first.height) / FISHEYE_VIEW
        return replace(first, fx=focal, fy=focal, fisheye=True)
    swing = 1.0 + BREATHING * math.sin(6.0 * math.pi * share)
    factors = {"zoom": ZOOM**share, "switch": ZOOM if share > 0.5 else 1.0, "breathing": swing}
    return first.zoomed(factors[kind]) if kind in factors else first


@dataclass(frozen=True)
class Shutter:
    """Poses of the rows of the sensor in the S samples of an exposure.

    With a global shutter all rows of a sample have the same pose. With a rolling shutter each row has
    separate poses, which are later for lower rows.
    """

    poses: ArrayF64  # [T, 3, 4] in the order of time
    index: NDArray[np.intp]  # [S, H] into poses
    times: ArrayF64 = field(default_factory=lambda: np.zeros(1))  # [T or 1] seconds, for moving objects

    @property
    def samples(self) -> int:
        return len(self.index)


def instant_shutter(pose: ArrayF64, height: int) -> Shutter:  # [3, 4]
    """Return a shutter without motion: one pose for all rows and samples."""
    return Shutter(pose[None], np.zeros((MIN_SAMPLES, height), np.intp))


@dataclass(frozen=True)
class Aperture:
    """A thin lens: one point of the aperture per sample."""

    points: ArrayF64 = field(default_factory=lambda: np.zeros((1, 2)))  # [S or 1, 2] world units
    focus: float = 1.0
    """Distance in focus, world units."""


PINHOLE = Aperture()


class World(Protocol):
    """A scene that can be rendered."""

    def render(self, shutter: Shutter, lens: Lens, aperture: Aperture = PINHOLE) -> ArrayF64:
        """Return the mean of the samples [H, W, 3] in linear light; 1 is sensor white."""

    def depth(self, pose: ArrayF64, lens: Lens) -> ArrayF64:
        """Return the camera z at the pixel centres [H, W], world units; 0 without a surface."""


def low_discrepancy(count: int) -> ArrayF64:
    """Return points [count, 2] that cover the unit square evenly (Roberts' R2 sequence)."""
    steps = np.array([0.7548776662466927, 0.5698402909980532])
    return np.asarray((0.5 + np.arange(count)[:, None] * steps) % 1.0, np.float64)


def disc(count: int, radius: float) -> ArrayF64:
    """Return points [count, 2] that cover a disc evenly (sunflower spiral)."""
    number = np.arange(count) + 0.5
    angle = number * math.pi * (3 - math.sqrt(5))
    unit = np.sqrt(number / count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    return np.asarray(radius * unit, np.float64)


def distorted(
    light: ArrayF64,  # [H, W, 3] linear
    lens: Lens,
    coefficients: tuple[float, float, float, float],  # k1, k2, p1 and p2 of OpenCV's model
) -> ArrayF64:  # [H, W, 3]
    """Return the image of a lens with distortion, computed from that of ``lens``, which has none.

    The ray of each pixel is found by fixed-point iteration. Pixels whose ray is outside the image repeat its
    border.
    """
    k1, k2, p1, p2 = coefficients
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    seen = np.stack([(columns - lens.cx) / lens.fx, (rows - lens.cy) / lens.fy])
    x, y = seen
    for _ in range(20):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (seen[0] - dx) / radial, (seen[1] - dy) / radial
    where = [(axis - 0.5).astype(np.float32) for axis in (x * lens.fx + lens.cx, y * lens.fy + lens.cy)]
    found = cv2.remap(light, where[0], where[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.maximum(np.asarray(found, np.float64), 0.0)
