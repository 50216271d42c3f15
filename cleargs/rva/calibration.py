"""From raw measures to cues in [0, 1]: the response curves and every constant in them.

Rule behind the blur constants: a frame whose full weight in training does no harm should reach the paper's
R >= 0.70. Measured on two synthetic captures of 320x180 px, half of whose frames are blurred by a motion of L
(docs/experiments/rva.md): full weight gains in PSNR and SSIM at 2.5 px and loses to a weight of 0.4 at 4 px.
Their mean R is 0.82 at 2.5 px, 0.67 at 4 px and 0.54 at 6 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cleargs.rva.scores import Floats


@dataclass(frozen=True)
class Calibration:
    """Constants of the cues. Extents are standard deviations of the blur in px at the reduced size."""

    neighbours: int = 4
    """Frames before and after whose best is taken for what the content itself looks like."""
    content_detail: tuple[float, float] = (3.0, 5.0)
    """Bounds of the detail ratio that content may have: step edges (softer neighbours do not excuse a frame)
    and rich texture (a crisper neighbour shows something else)."""
    sharpness_half: float = 0.8
    """Extent in the worst direction, px, at which r_sharpness is 1/2."""
    structure_half: float = 0.7
    """Mean extent over the directions at which r_structure is 1/2."""
    steepness: float = 3.0
    """Exponent of the blur curves."""
    noticeable: float = 0.5
    """Extent, px, that sharp frames reach by their content alone."""
    motion_half: float = 1.2
    """Visible extent in the worst direction at which b_motion_blur is 1/2."""
    defocus_half: float = 1.2
    """Visible extent in the best direction at which b_defocus is 1/2."""
    isotropy_range: tuple[float, float] = (0.80, 0.92)
    """Least extent over largest at which a blur is taken for a motion's, and for a disc's."""
    detail_range: tuple[float, float] = (0.10, 1.0)
    """Share of the content's fine detail at which r_texture is 0 and 1: content alone varies it."""
    contrast_range: tuple[float, float] = (0.02, 0.10)
    """Spread of the luma (of 1) at which texture is not to be relied on at all, and fully."""
    noise_half: float = 8.0
    """Noise, levels of 255, at which r_cleanness is 1/2."""
    blocking_half: float = 4.0
    """Blocking at which the artifacts cue is 1/2; videos of good quality stay below 2."""
    ringing_half: float = 10.0
    """Ringing, levels, at which the artifacts cue is 1/2."""
    ghost_content: float = 0.10
    """Content explains at most this height of a cepstral side peak, however high the neighbours'."""
    ghost_range: tuple[float, float] = (0.04, 0.16)
    """Excess of the side peak at which b_ghosting is 0 and 1."""
    clipped_range: tuple[float, float] = (0.10, 0.50)
    """Share of clipped pixels, beyond the least clipped neighbour's, at which exposure is good, and lost."""
    dark_range: tuple[float, float] = (0.20, 0.04)
    """Mean luma (of 1) at which darkness begins to hurt and exposure is lost."""
    bright_range: tuple[float, float] = (0.70, 0.95)
    """Mean luma at which brightness begins to hurt and exposure is lost."""
    stops_range: tuple[float, float] = (0.4, 2.0)
    """Jump of the mean luma from the neighbours' median, in stops, that is harmless, and that is failure."""


def ramp(value: Floats, ends: tuple[float, float]) -> Floats:
    """0 at the first end and beyond, 1 at the second, linear between; the ends may fall."""
    return np.clip((value - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)


def decay(value: Floats, half: float, steepness: float) -> Floats:
    """1 at 0, 1/2 at ``half``, towards 0: 1 / (1 + (value / half)^steepness)."""
    return np.asarray(1.0 / (1.0 + (value / half) ** steepness))
