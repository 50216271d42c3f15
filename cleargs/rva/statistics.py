"""The embedded evaluator: the eleven cues from image statistics and from the frame's neighbours in the video.

Each frame is measured alone (`measure`); then its measures are set against those of its neighbours
(`cues_from_measures`), since a single image cannot tell soft content from blur, while frames around it that
show nearly the same content can. Response curves take raw measures to cues in [0, 1].

Rule behind the blur constants: a frame whose full weight in training does no harm should reach the paper's
R >= 0.70. Measured on two synthetic captures of 320x180 px, half of whose frames are blurred by a motion of L
(docs/experiments/rva.md): full weight gains in PSNR and SSIM at 2.5 px and loses to a weight of 0.4 at 4 px.
Their mean R is 0.82 at 2.5 px, 0.67 at 4 px and 0.54 at 6 px.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import cv2
import numpy as np

from cleargs.progress import Reporter
from cleargs.rva import measures
from cleargs.rva.arrays import Floats
from cleargs.rva.evaluator import ItemCache, View, view_digest
from cleargs.rva.measures import DIRECTIONS, Luminance, detail_ratios, extents_from_ratios, load_luminance


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


@dataclass(frozen=True)
class Measures:
    """Raw measures of n frames, in trajectory order."""

    detail: Floats  # [n, DIRECTIONS] see measures.detail_ratios
    noise: Floats  # [n] levels of 255
    blocking: Floats  # [n]
    ringing: Floats  # [n] levels of 255
    ghosting: Floats  # [n] height of a cepstral peak
    mean: Floats  # [n] luma, of 1
    clipped: Floats  # [n] share of the pixels
    spread: Floats  # [n] luma, of 1


MEASURE_COLUMNS = (
    *(f"detail_{k}" for k in range(DIRECTIONS)),
    *(field.name for field in fields(Measures) if field.name != "detail"),
)
"""Names of the numbers in a row of `measure`."""


def measure(luminance: Luminance) -> Floats:
    """All raw measures of one frame as a row, in the order of `MEASURE_COLUMNS`."""
    image, valid = luminance.reduced, luminance.valid
    noise = measures.noise_level(image, valid)
    return np.array(
        [
            *detail_ratios(image, valid, noise),
            noise,
            measures.blocking(luminance.full),
            measures.ringing(image, valid, noise),
            measures.ghosting(image, noise),
            *astuple(measures.exposure(image, valid)),
        ]
    )


def as_measures(rows: Floats) -> Measures:
    """Name the columns of stacked rows of `measure`."""
    return Measures(rows[:, :DIRECTIONS], *rows[:, DIRECTIONS:].T)


class StatisticsEvaluator:
    """Evaluator ``statistics``: no network, no weights, the same cues for any number of threads."""

    name = "statistics"
    version = 2

    def __init__(self, cache: Path | None = None) -> None:
        """``cache`` is a folder in which the measures of single frames are kept."""
        self._cache = ItemCache(cache, MEASURE_COLUMNS) if cache else None

    def evaluate(self, views: Sequence[View], *, threads: int, reporter: Reporter) -> Floats:
        """See `Evaluator.evaluate`. Raises StoreError when an image cannot be read."""
        if not views:
            return np.zeros((0, 11))
        rows = []
        with ThreadPoolExecutor(max(1, threads)) as pool, reporter.task("cues", total=len(views)) as task:
            for row in pool.map(self._measure, views):
                rows.append(row)
                task.advance()
        return cues_from_measures(as_measures(np.stack(rows)), Calibration())

    def _measure(self, view: View) -> Floats:
        if self._cache is None:
            return measure(load_luminance(view))
        digest = view_digest([self.name, self.version, cv2.__version__], view)
        row = self._cache.find(digest)
        if row is None:
            row = measure(load_luminance(view))
            self._cache.add(digest, row)
        return row


def cues_from_measures(m: Measures, c: Calibration) -> Floats:  # [n, 11] in [0, 1]
    """The cues in the order of `tables.CUE_COLUMNS`; each column's function says what it is."""
    extents = blur_extents(m, c)
    texture = texture_reliability(m, c)
    artifacts = artifact_freedom(m, c)
    exposed = exposure_quality(m, c)
    return np.stack(
        [
            sharpness(extents, c),
            structure(extents, c),
            texture,
            cleanness(m, artifacts, c),
            exposed,
            motion_blur(extents, c),
            defocus(extents, c),
            ghosting(m, c),
            exposure_failure(exposed),
            unreliable_texture(m, texture, c),
            1.0 - artifacts,
        ],
        axis=1,
    )


def around(values: Floats, pick: Callable[..., Floats], reach: int) -> Floats:  # [n, ...] -> [n, ...]
    """``pick`` (np.min, np.max, np.median) over each frame and up to ``reach`` neighbours on either side."""
    n = len(values)
    return np.stack([pick(values[max(0, i - reach) : i + reach + 1], axis=0) for i in range(n)])


def content_detail(m: Measures, c: Calibration) -> Floats:  # [n, DIRECTIONS]
    """What the frame's content shows where it is sharp: the best ratio among the neighbours, direction by
    direction, within `content_detail`.

    Failure modes: a cut in the video, or neighbours so far apart that they show other things (the upper bound
    limits the damage); a capture that is blurred throughout (the lower bound keeps it from being excused).
    """
    return np.clip(around(m.detail, np.max, c.neighbours), *c.content_detail)


def blur_extents(m: Measures, c: Calibration) -> Floats:  # [n, DIRECTIONS] px
    """Standard deviation of the blur along each direction, given the content."""
    return extents_from_ratios(m.detail, content_detail(m, c))


def sharpness(extents: Floats, c: Calibration) -> Floats:
    """r_sharpness: 1 where no direction is blurred, 1/2 at `sharpness_half` in the worst one."""
    return decay(extents.max(axis=1), c.sharpness_half, c.steepness)


def structure(extents: Floats, c: Calibration) -> Floats:
    """r_structure: clarity of edges and corners of any orientation, by the blur's mean over the directions.

    A motion leaves the edges along it intact, so structure suffers less from it than from an equal defocus.
    """
    return decay(extents.mean(axis=1), c.structure_half, c.steepness)


def texture_reliability(m: Measures, c: Calibration) -> Floats:
    """r_texture: share of the content's fine detail that the frame keeps, where it has contrast at all.

    Detail is counted from 1, what a fully blurred image shows (`measures.detail_ratios`).
    Failure modes: as for `content_detail`.
    """
    kept = (m.detail.mean(axis=1) - 1.0) / (content_detail(m, c).mean(axis=1) - 1.0)
    return ramp(kept, c.detail_range) * ramp(m.spread, c.contrast_range)


def artifact_freedom(m: Measures, c: Calibration) -> Floats:
    """1 - b_artifacts: no blocks on an 8 px grid and no ripples beside strong edges."""
    return decay(m.blocking, c.blocking_half, 2.0) * decay(m.ringing, c.ringing_half, 2.0)


def cleanness(m: Measures, artifacts: Floats, c: Calibration) -> Floats:
    """r_cleanness: free of noise, blocks and ringing."""
    return artifacts * decay(m.noise, c.noise_half, 2.0)


def exposure_quality(m: Measures, c: Calibration) -> Floats:
    """r_exposure: neither clipped nor dark nor glaring, and as bright as its neighbours.

    Clipping is counted beyond the least clipped neighbour's: a window or a lamp in view is content. Failure
    mode: a capture that is badly exposed throughout is only caught by its mean.
    """
    clipped = ramp(m.clipped - np.minimum(around(m.clipped, np.min, c.neighbours), 0.5), c.clipped_range)
    level = np.maximum(m.mean, 1.0 / 255.0)
    stops = np.abs(np.log2(level / around(level, np.median, c.neighbours)))
    tonal = np.maximum(ramp(m.mean, c.dark_range), ramp(m.mean, c.bright_range))
    return (1.0 - clipped) * (1.0 - tonal) * (1.0 - ramp(stops, c.stops_range))


def exposure_failure(quality: Floats) -> Floats:
    """b_exposure_failure: the loss of exposure quality, mild ones forgiven: (1 - q)^2 (3 - 2 (1 - q))."""
    loss = 1.0 - quality
    return loss * loss * (3.0 - 2.0 * loss)


def visible(extents: Floats, c: Calibration) -> Floats:
    """Extents beyond `noticeable`, as variances subtract: 0 for all that content alone may explain."""
    return np.asarray(np.sqrt(np.maximum(extents**2 - c.noticeable**2, 0.0)))


def isotropy(extents: Floats, c: Calibration) -> Floats:
    """Whether a blur is a disc's (1) or a motion's (0), by the least extent over the largest."""
    return ramp(extents.min(axis=1) / np.maximum(extents.max(axis=1), 1e-9), c.isotropy_range)


def motion_blur(extents: Floats, c: Calibration) -> Floats:
    """b_motion_blur: the visible blur of the worst direction, where it is not the same in all.

    Failure modes: a rotation about the optical axis or a curved path blurs all directions and reads as
    defocus; a moving object in a sharp scene shows only if it has much of the frame's detail.
    """
    blurred = 1.0 - decay(visible(extents.max(axis=1), c), c.motion_half, c.steepness)
    return (1.0 - isotropy(extents, c)) * blurred


def defocus(extents: Floats, c: Calibration) -> Floats:
    """b_defocus: the visible blur that even the best direction has, where it is the same in all. Failure
    modes: as for `motion_blur`."""
    blurred = 1.0 - decay(visible(extents.min(axis=1), c), c.defocus_half, c.steepness)
    return isotropy(extents, c) * blurred


def ghosting(m: Measures, c: Calibration) -> Floats:
    """b_ghosting: a second image of everything, by the side peak of the cepstrum beyond the neighbours'.

    Failure modes: see `measures.ghosting`; ghosts of single moving objects are not seen.
    """
    content = np.minimum(around(m.ghosting, np.min, c.neighbours), c.ghost_content)
    return ramp(m.ghosting - content, c.ghost_range)


def unreliable_texture(m: Measures, texture: Floats, c: Calibration) -> Floats:
    """b_unreliable_texture: fine detail lost, or drowned in noise."""
    return 1.0 - texture * decay(m.noise, c.noise_half, 2.0)
