"""Types that all packages share. Shapes of arrays are stated where an array is used."""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Device: TypeAlias = Literal["cpu", "cuda"]
ImageU8: TypeAlias = NDArray[np.uint8]
"""An 8-bit image: sRGB [H, W, 3], or grey [H, W]."""
ImageF32: TypeAlias = NDArray[np.float32]
"""An image [H, W, 3] with values in [0, 1], sRGB unless stated otherwise."""
AnyImage: TypeAlias = NDArray[Any]
"""An `ImageU8` or an `ImageF32`."""
PlaneF32: TypeAlias = NDArray[np.float32]
"""One number per pixel [H, W]: luminance, depth or alpha."""

MaskBool: TypeAlias = NDArray[np.bool_]
"""A mask [H, W]: pixels that are True count."""
MaskU8: TypeAlias = NDArray[np.uint8]
"""A mask [H, W] as image files store it: pixels that are 0 do not count."""

ArrayF32: TypeAlias = NDArray[np.float32]
ArrayF64: TypeAlias = NDArray[np.float64]
ArrayBool: TypeAlias = NDArray[np.bool_]
ArrayInt: TypeAlias = NDArray[np.integer]
AnyArray: TypeAlias = NDArray[Any]
