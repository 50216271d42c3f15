"""Detection of what frames the scene in every picture: bars, the black around a fisheye circle, a lens hood.

A border is even and still, as dark or clipped parts of a scene can be. The difference is at its inner edge.
The scene reaches up to a border in every picture, whereas the edge of a dark part of the scene moves with the
camera, so that pixels next to a part that is dark in all pictures are dark in many of them.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.types import ArrayF32, MaskBool, MaskU8

STILL = 4.0
"""Maximum standard deviation of a still pixel over the pictures, levels. JPEG and H.264 cause 1 to 3."""

_EVEN, _EVEN_SHARE = 32, 0.9  # levels by which pixels of a border may differ, and least share that do not
_WHOLE = 0.995  # share of a row or column that must be still for a bar
_LEAST = 0.0003, 12  # least share of the picture, and least number of pixels along the inner edge
_REACH = 0.1  # width of the zone in which the edge of a border is searched, as a share of the short side
_QUANTILE = 0.2  # quantile over the pictures: 0 at a pixel that is dark in a fifth of them
_KEPT = 0.3  # share of that quantile further inside that must be left where the mean difference is half
_VISIBLE = 2.0, 6.0  # least difference of the scene from a border: levels, and in deviations of the border
_SHARP, _DARK = 10, 48  # width of an edge, px, from which it is that of a lens hood, and its brightest level
_MOVES = 4.0, 0.5  # deviation next to a border, in that of the border, and in the median of the picture
_FULL = 0.9  # share of the scene's difference from which a pixel is no longer part of a soft edge

_SOFT, _SOFT_MOST = 0.2, 0.4  # detail of blurred bars in that of the picture: mean, and most
_ROUNDED = 2.0  # Laplacian, levels, that rounding to whole levels causes in a smooth area
_SEAM = 3.0  # least step at the inner edge of a blurred bar, in steps inside the bar
_SOFT_WIDTH, _UNEQUAL = 0.03, 0.01  # least width of a blurred bar, largest difference between two: shares


def even_border(stack: MaskU8, deviation: ArrayF32) -> MaskBool:
    """Return the even, still areas at the border of all pictures [H, W]; soft edges are included.

    ``stack`` [K, H, W] has the luminance of several pictures, ``deviation`` [H, W] its standard deviation.
    """
    still = deviation <= STILL
    found = np.zeros_like(still)
    for part in [*_areas(still), *_bars(still)]:
        if not found[part].all():
            found |= _with_edge(part, stack, deviation)
    if not found.any():
        return found
    # Text that changes in a bar is an island.
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~found).astype(np.uint8), connectivity=4)
    return np.asarray(labels != 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])) if len(stats) > 1 else found)


def _areas(still: MaskBool) -> Iterator[MaskBool]:
    """Yield the connected areas of ``still`` [H, W] at the border."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(still.astype(np.uint8), connectivity=4)
    edges = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    for label in edges[edges > 0]:
        if stats[label, cv2.CC_STAT_AREA] >= _LEAST[0] * still.size:
            yield np.asarray(labels == label)


def _bars(still: MaskBool) -> Iterator[MaskBool]:
    """Yield the rows and columns at each side that are ``still`` [H, W]: bars next to a dark scene."""
    for axis in (0, 1):
        lines = still.mean(axis=1 - axis) >= _WHOLE
        if lines.all():
            return
        for ends in (slice(0, int(np.argmin(lines))), slice(len(lines) - int(np.argmin(lines[::-1])), None)):
            part = np.zeros_like(still)
            part[(ends, slice(None)) if axis == 0 else (slice(None), ends)] = True
            if part.any():
                yield part


def _with_edge(part: MaskBool, stack: MaskU8, deviation: ArrayF32) -> MaskBool:
    """Return ``part`` [H, W] with its soft edge if it is even and a border; else nothing."""
    nothing, mean = np.zeros_like(part), stack.mean(axis=0, dtype=np.float32)
    outermost = np.ones_like(part)
    outermost[1:-1, 1:-1] = False
    level = np.median(mean[part & outermost])
    even = np.abs(mean - level) <= _EVEN
    if even[part & outermost].mean() < _EVEN_SHARE:
        return nothing  # a patterned bar
    part = part & even  # without still parts of the scene next to it
    reach = max(12, round(_REACH * min(part.shape)))
    distance = cv2.distanceTransform((~part).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    # Other still parts are judged on their own.
    rows, columns = np.nonzero((distance > 0) & (distance <= 3 * reach) & (deviation > STILL))
    rings = np.ceil(distance[rows, columns]).astype(np.int64)
    counts = np.bincount(rings, minlength=3 * reach + 1)[1 : 3 * reach + 1]
    if counts[:reach].min() < _LEAST[1]:
        return nothing
    noise = float(np.median(deviation[part]))
    off = np.abs(stack[:, rows, columns].astype(np.float32) - level)
    low = np.partition(off, int(_QUANTILE * len(stack)), axis=0)[int(_QUANTILE * len(stack))]

    def profile(values: ArrayF32) -> NDArray[np.float64]:
        sums = np.bincount(rings, weights=values, minlength=3 * reach + 1)[1 : 3 * reach + 1]
        return np.asarray(sums / np.maximum(counts, 1))

    most, least = profile(off.mean(axis=0)), profile(low)
    inside = slice(reach, 2 * reach)
    scene = float(np.median(most[inside])), float(np.median(least[inside]))
    if scene[1] < max(_VISIBLE[0], _VISIBLE[1] * noise):
        return nothing
    half = int(np.argmax(most >= 0.5 * scene[0]))
    if half >= (_SHARP if level > _DARK else reach) or least[half] < _KEPT * scene[1]:
        return nothing
    moves = float(np.median(profile(deviation[rows, columns])[half : half + reach]))
    if moves < max(_MOVES[0] * noise, _MOVES[1] * float(np.median(deviation[~part]))):
        return nothing  # a plain wall
    ahead = [float(np.median(most[d : d + reach])) for d in range(reach)]
    full = [d for d in range(half, reach) if most[d] >= _FULL * ahead[d]]
    return np.asarray(distance <= (full[0] if full else half) + 1)


def blurred_border(stack: MaskU8) -> MaskBool:  # [H, W]
    """Return two bars of equal width at opposite sides that have no detail in any picture, with a clear edge.

    Programs that fit an upright video into a wide frame fill the sides with its blurred, enlarged picture.
    """
    height, width = stack.shape[1:]
    detail = np.stack(
        [np.maximum(np.abs(cv2.Laplacian(picture, cv2.CV_32F)) - _ROUNDED, 0) for picture in stack]
    )
    found = np.zeros((height, width), np.bool_)
    for axis in (1, 2):
        lines = detail.mean(axis=3 - axis)  # [K, n]
        steps = np.abs(np.diff(stack.astype(np.int16), axis=axis)).mean(axis=(0, 3 - axis))
        size = lines.shape[1]
        middle = lines[:, size // 3 : -(size // 3)].mean(axis=1)
        soft = lines.mean(axis=0) < _SOFT * middle.mean()
        first, last = int(np.argmin(soft)), int(np.argmin(soft[::-1]))
        if min(first, last) < _SOFT_WIDTH * size or abs(first - last) > max(2, _UNEQUAL * size):
            continue
        bars = slice(0, first - 1), slice(size - last + 1, size)
        # JPEG's blocks spread the detail beyond the edge by up to 7 px.
        zones = slice(first - 3, first + 9), slice(size - last - 9, size - last + 3)
        if all(_is_soft(lines, steps, middle, bar, zone) for bar, zone in zip(bars, zones, strict=True)):
            edges = [zone.start + int(np.argmax(steps[zone])) for zone in zones]
            across = np.zeros(size, np.bool_)
            across[: edges[0] + 2] = across[edges[1] :] = True
            found |= across[:, None] if axis == 1 else across[None]
    return found


def _is_soft(lines: ArrayF32, steps: NDArray[np.float64], middle: ArrayF32, bar: slice, zone: slice) -> bool:
    """Return True if a ``bar`` has no detail in any picture, and a step in the ``zone`` of its edge."""
    most = np.quantile(lines[:, bar].mean(axis=1) / np.maximum(middle, 1e-3), 0.9)
    return bool(most < _SOFT_MOST and steps[zone].max() > _SEAM * max(float(np.median(steps[bar])), 0.5))
