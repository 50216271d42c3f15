"""The embedded evaluator: the eleven cues from image statistics and from the frame's neighbours in the video.

Each frame is measured alone (`measure`); then its measures are set against those of its neighbours
(`cues_from_measures`), since a single image cannot tell soft content from blur, while frames around it that
show nearly the same content can.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import cv2
import numpy as np

from cleargs.progress import Reporter
from cleargs.rva import degradations
from cleargs.rva.blur import DIRECTIONS, detail_ratios, extents_from_ratios
from cleargs.rva.calibration import Calibration, decay, ramp
from cleargs.rva.evaluator import View
from cleargs.rva.item_cache import ItemCache, view_digest
from cleargs.rva.luminance import Luminance, load_luminance
from cleargs.rva.scores import Floats


@dataclass(frozen=True)
class Measures:
    """Raw measures of n frames, in trajectory order."""

    detail: Floats  # [n, DIRECTIONS] see blur.detail_ratios
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
    noise = degradations.noise_level(image, valid)
    return np.array(
        [
            *detail_ratios(image, valid, noise),
            noise,
            degradations.blocking(luminance.full),
            degradations.ringing(image, valid, noise),
            degradations.ghosting(image, noise),
            *astuple(degradations.exposure(image, valid)),
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
    """Standard deviation of the blur along each direction, given the content (`blur.extents_from_ratios`)."""
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

    Detail is counted from 1, what a fully blurred image shows (`blur.detail_ratios`). Failure modes: as for
    `content_detail`.
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

    Failure modes: see `degradations.ghosting`; ghosts of single moving objects are not seen.
    """
    content = np.minimum(around(m.ghosting, np.min, c.neighbours), c.ghost_content)
    return ramp(m.ghosting - content, c.ghost_range)


def unreliable_texture(m: Measures, texture: Floats, c: Calibration) -> Floats:
    """b_unreliable_texture: fine detail lost, or drowned in noise."""
    return 1.0 - texture * decay(m.noise, c.noise_half, 2.0)
