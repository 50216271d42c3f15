"""What both back ends' frame warps agree on: images, fields, curves, and a frame's motion in numbers."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

CHANNELS = 4
"""Of an image in linear light: RGB and one of padding, so that a pixel is read at once."""

CURVE_LAST = 2.0
CURVE_STEPS = 8192
CURVE_DENSITY = CURVE_STEPS / CURVE_LAST
"""The curves between sRGB and linear light are tables of so many steps from 0 to `CURVE_LAST`, with straight
lines between them and beyond: within 2e-5 of the formulas, and their derivative is exact."""

MIN_COVERED = 0.5
"""Alpha from which a pixel has a depth."""
MAX_NEARNESS = 4.0
"""Of a pixel, as a multiple of the median one: what floats before the lens would move by whole images."""

# A frame's motion as the kernels read it: a row of float32, lengths in pixels of the photograph.
FX = 0
FY = 1
CX = 2
CY = 3
MEDIAN = 4  # depth
DISC = 5  # radius per unit of nearness
FOCUS = 6  # nearness
TWISTS = 7  # pose, blur and skew, six numbers each
MOTION_COLUMNS = 25


class DisplacementFields(NamedTuple):
    """Where the pixels of a photograph look while they are exposed, in px, x before y: see the kernels."""

    offset: Tensor  # [2, H, W]
    sweep: Tensor  # [2, H, W]
    radius: Tensor  # [H, W]
    reach: float | None = None
    """Farthest that a pixel looks up or down; None where it is not known."""
