"""Data layouts of both back ends' frame warps: images, fields, curves and the motion of a frame."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

CHANNELS = 4
"""Channels of an image in linear light: RGB and one of padding, so that one load reads a pixel."""

CURVE_LAST = 2.0
CURVE_STEPS = 8192
CURVE_DENSITY = CURVE_STEPS / CURVE_LAST
"""The curves between sRGB and linear light are tables of `CURVE_STEPS` steps from 0 to `CURVE_LAST`, linear
between and beyond the steps. They are within 2e-5 of the formulas. Slopes are exactly those of the table."""

MIN_COVERED = 0.5
"""A pixel has a depth if its alpha is above this."""
MAX_NEARNESS = 4.0
"""Upper limit of a pixel's nearness (median depth / depth), which bounds the motion of nearby floaters."""

READ_STEPS = 3
"""Times that the displacement by a rolling shutter is computed again, from the middle of its path and the
nearness at its end. The number is odd: where a pixel sees what the still image hides, the nearness alternates
between that in front and that behind, and from the one in front the pixel gets the colour behind."""

# A frame's motion as the kernels read it: a row of float32, lengths in pixels of the formed image.
FX = 0
FY = 1
CX = 2
CY = 3
MEDIAN = 4  # median depth, scene units
DISC = 5  # radius of the defocus disc per unit of nearness
FOCUS = 6  # nearness that is in focus
READ_ACROSS = 7  # 1 if columns are read one after the other, else 0
READ_DOWN = 8  # 1 if rows are
TWISTS = 9  # pose, blur, skew, skew_bend, bend and cube: translation and rotation, six numbers each
SKEW = slice(21, 27)  # numbers of skew; zero with a global shutter
CURVES = 33  # first number of bend; bend and cube are zero on a straight path
MOTION_COLUMNS = 45

BEND_REACH = 1.0 / 6.0
CUBE_REACH = 1.0 / 20.0
"""Largest absolute values, for t from -1/2 to 1/2, of t^2 - 1/12 and t^3 - 3t/20."""


class DisplacementFields(NamedTuple):
    """Displacements of a formed image's pixels in px, x before y; ``frame_warp`` has the formula."""

    offset: Tensor  # [2, H, W] mean over the exposure
    sweep: Tensor  # [2, H, W] over the exposure, by the part of the path that is linear in time
    radius: Tensor  # [H, W] of the defocus disc
    reach: float | None = None
    """Largest vertical displacement, px; None if it is unknown."""
    curve: Tensor | None = None  # [4, H, W] bend, then cube
    """Parts of the path of second and third order in time; None for straight paths."""
