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
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np

from cleargs.progress import Reporter
from cleargs.rva import measures
from cleargs.rva.evaluator import EvaluatedFrame, ItemCache, load_view
from cleargs.rva.measures import DIRECTIONS, Luminance, detail_ratios, extents_from_ratios, reduce_luminance
from cleargs.types import ArrayF64

# Extents are standard deviations of the blur in px at the reduced size.
_NEIGHBOURS = 4  # frames before and after whose best is taken for what the content itself looks like
# Bounds of the detail ratio that content may have: step edges (softer neighbours do not excuse a frame) and
# rich texture (a crisper neighbour shows something else).
_CONTENT_DETAIL = (3.0, 5.0)
_SHARPNESS_HALF = 0.8  # extent in the worst direction, px, at which r_sharpness is 1/2
_STRUCTURE_HALF = 0.7  # mean extent over the directions at which r_structure is 1/2
_STEEPNESS = 3.0  # exponent of the blur curves
_NOTICEABLE = 0.5  # extent, px, that sharp frames reach by their content alone
_MOTION_HALF = 1.2  # visible extent in the worst direction at which b_motion_blur is 1/2
_DEFOCUS_HALF = 1.2  # visible extent in the best direction at which b_defocus is 1/2
_ISOTROPY = (0.80, 0.92)  # least extent over largest of a motion's blur, and of a disc's
_DETAIL = (0.10, 1.0)  # share of the content's fine detail at which r_texture is 0 and 1: content varies it
_CONTRAST = (0.02, 0.10)  # spread of the luma (of 1) at which texture is not relied on at all, and fully
_NOISE_HALF = 8.0  # noise, levels of 255, at which r_cleanness is 1/2
_BLOCKING_HALF = 4.0  # blocking at which the artifacts cue is 1/2; videos of good quality stay below 2
_RINGING_HALF = 10.0  # ringing, levels, at which the artifacts cue is 1/2
_GHOST_CONTENT = 0.10  # height of a cepstral side peak that content explains at most
_GHOST = (0.04, 0.16)  # excess of the side peak at which b_ghosting is 0 and 1
_CLIPPED = (0.10, 0.50)  # share of clipped pixels beyond the least clipped neighbour's: good, and lost
_DARK = (0.20, 0.04)  # mean luma (of 1) at which darkness begins to hurt and exposure is lost
_BRIGHT = (0.70, 0.95)  # mean luma at which brightness begins to hurt and exposure is lost
_STOPS = (0.4, 2.0)  # jump of the mean luma from the neighbours' median, in stops: harmless, and failure


def ramp(value: ArrayF64, ends: tuple[float, float]) -> ArrayF64:
    """0 at the first end and beyond, 1 at the second, linear between; the ends may fall."""
    return np.clip((value - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)


def decay(value: ArrayF64, half: float, steepness: float) -> ArrayF64:
    """1 at 0, 1/2 at ``half``, towards 0: 1 / (1 + (value / half)^steepness)."""
    return np.asarray(1.0 / (1.0 + (value / half) ** steepness))


@dataclass(frozen=True)
class Measures:
    """Raw measures of n frames, in trajectory order."""

    detail: ArrayF64  # [n, DIRECTIONS] see measures.detail_ratios
    noise: ArrayF64  # [n] levels of 255
    blocking: ArrayF64  # [n]
    ringing: ArrayF64  # [n] levels of 255
    ghosting: ArrayF64  # [n] height of a cepstral peak
    mean: ArrayF64  # [n] luma, of 1
    clipped: ArrayF64  # [n] share of the pixels
    spread: ArrayF64  # [n] luma, of 1


MEASURE_COLUMNS = (
    *(f"detail_{k}" for k in range(DIRECTIONS)),
    *(field.name for field in fields(Measures) if field.name != "detail"),
)
"""Names of the numbers in a row of `measure`."""


def measure(luminance: Luminance) -> ArrayF64:
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
            *measures.exposure(image, valid),
        ]
    )


class StatisticsEvaluator:
    """Evaluator ``statistics``: no network, no weights, the same cues for any number of threads."""

    name = "statistics"
    version = 2

    def __init__(self, cache: Path | None = None) -> None:
        """``cache`` is a folder in which the measures of single frames are kept."""
        self._cache = ItemCache(cache, MEASURE_COLUMNS, [self.name, self.version, cv2.__version__])

    def evaluate(self, views: Sequence[EvaluatedFrame], *, threads: int, reporter: Reporter) -> ArrayF64:
        """See `Evaluator.evaluate`. Raises StoreError when an image cannot be read."""
        if not views:
            return np.zeros((0, 11))
        rows = []
        with ThreadPoolExecutor(max(1, threads)) as pool, reporter.task("cues", total=len(views)) as task:
            for row in pool.map(self._measure, views):
                rows.append(row)
                task.advance()
        return cues_from_measures(np.stack(rows))

    def _measure(self, view: EvaluatedFrame) -> ArrayF64:
        return self._cache.row(view, lambda view: measure(reduce_luminance(*load_view(view))))


def cues_from_measures(rows: ArrayF64) -> ArrayF64:  # [n, 11] in [0, 1]
    """The cues in the order of `tables.CUE_COLUMNS`, from rows of `measure`; each column's function says what
    it is.
    """
    m = Measures(rows[:, :DIRECTIONS], *rows[:, DIRECTIONS:].T)
    content = content_detail(m)
    extents = extents_from_ratios(m.detail, content)
    texture = texture_reliability(m, content)
    artifacts = artifact_freedom(m)
    exposed = exposure_quality(m)
    return np.stack(
        [
            sharpness(extents),
            structure(extents),
            texture,
            cleanness(m, artifacts),
            exposed,
            motion_blur(extents),
            defocus(extents),
            ghosting(m),
            exposure_failure(exposed),
            unreliable_texture(m, texture),
            1.0 - artifacts,
        ],
        axis=1,
    )


def around(values: ArrayF64, pick: Callable[..., ArrayF64]) -> ArrayF64:  # [n, ...] -> [n, ...]
    """``pick`` (np.min, np.max, np.median) over each frame and up to _NEIGHBOURS on either side."""
    spans = [slice(max(0, i - _NEIGHBOURS), i + _NEIGHBOURS + 1) for i in range(len(values))]
    return np.stack([pick(values[span], axis=0) for span in spans])


def content_detail(m: Measures) -> ArrayF64:  # [n, DIRECTIONS]
    """What the frame's content shows where it is sharp: the best ratio among the neighbours, direction by
    direction, within _CONTENT_DETAIL.

    Failure modes: a cut in the video, or neighbours so far apart that they show other things (the upper bound
    limits the damage); a capture that is blurred throughout (the lower bound keeps it from being excused).
    """
    return np.clip(around(m.detail, np.max), *_CONTENT_DETAIL)


def sharpness(extents: ArrayF64) -> ArrayF64:
    """r_sharpness: 1 where no direction is blurred, 1/2 at _SHARPNESS_HALF in the worst one."""
    return decay(extents.max(axis=1), _SHARPNESS_HALF, _STEEPNESS)


def structure(extents: ArrayF64) -> ArrayF64:
    """r_structure: clarity of edges and corners of any orientation, by the blur's mean over the directions.

    A motion leaves the edges along it intact, so structure suffers less from it than from an equal defocus.
    """
    return decay(extents.mean(axis=1), _STRUCTURE_HALF, _STEEPNESS)


def texture_reliability(m: Measures, content: ArrayF64) -> ArrayF64:
    """r_texture: share of the content's fine detail that the frame keeps, where it has contrast at all.

    Detail is counted from 1, what a fully blurred image shows (`measures.detail_ratios`).
    Failure modes: as for `content_detail`.
    """
    kept = (m.detail.mean(axis=1) - 1.0) / (content.mean(axis=1) - 1.0)
    return ramp(kept, _DETAIL) * ramp(m.spread, _CONTRAST)


def artifact_freedom(m: Measures) -> ArrayF64:
    """1 - b_artifacts: no blocks on an 8 px grid and no ripples beside strong edges."""
    return decay(m.blocking, _BLOCKING_HALF, 2.0) * decay(m.ringing, _RINGING_HALF, 2.0)


def cleanness(m: Measures, artifacts: ArrayF64) -> ArrayF64:
    """r_cleanness: free of noise, blocks and ringing."""
    return artifacts * decay(m.noise, _NOISE_HALF, 2.0)


def exposure_quality(m: Measures) -> ArrayF64:
    """r_exposure: neither clipped nor dark nor glaring, and as bright as its neighbours.

    Clipping is counted beyond the least clipped neighbour's: a window or a lamp in view is content. Failure
    mode: a capture that is badly exposed throughout is only caught by its mean.
    """
    clipped = ramp(m.clipped - np.minimum(around(m.clipped, np.min), 0.5), _CLIPPED)
    level = np.maximum(m.mean, 1.0 / 255.0)
    stops = np.abs(np.log2(level / around(level, np.median)))
    tonal = np.maximum(ramp(m.mean, _DARK), ramp(m.mean, _BRIGHT))
    return (1.0 - clipped) * (1.0 - tonal) * (1.0 - ramp(stops, _STOPS))


def exposure_failure(quality: ArrayF64) -> ArrayF64:
    """b_exposure_failure: the loss of exposure quality, mild ones forgiven: (1 - q)^2 (3 - 2 (1 - q))."""
    loss = 1.0 - quality
    return loss * loss * (3.0 - 2.0 * loss)


def isotropy(extents: ArrayF64) -> ArrayF64:
    """Whether a blur is a disc's (1) or a motion's (0), by the least extent over the largest."""
    return ramp(extents.min(axis=1) / np.maximum(extents.max(axis=1), 1e-9), _ISOTROPY)


def visible_blur(extents: ArrayF64, half: float) -> ArrayF64:
    """0 for what content alone may explain, 1/2 at ``half`` px beyond it, as variances subtract."""
    visible = np.sqrt(np.maximum(extents**2 - _NOTICEABLE**2, 0.0))
    return 1.0 - decay(visible, half, _STEEPNESS)


def motion_blur(extents: ArrayF64) -> ArrayF64:
    """b_motion_blur: the visible blur of the worst direction, where it is not the same in all.

    Failure modes: a rotation about the optical axis or a curved path blurs all directions and reads as
    defocus; a moving object in a sharp scene shows only if it has much of the frame's detail.
    """
    return (1.0 - isotropy(extents)) * visible_blur(extents.max(axis=1), _MOTION_HALF)


def defocus(extents: ArrayF64) -> ArrayF64:
    """b_defocus: the visible blur that even the best direction has, where it is the same in all. Failure
    modes: as for `motion_blur`.
    """
    return isotropy(extents) * visible_blur(extents.min(axis=1), _DEFOCUS_HALF)


def ghosting(m: Measures) -> ArrayF64:
    """b_ghosting: a second image of everything, by the side peak of the cepstrum beyond the neighbours'.

    Failure modes: see `measures.ghosting`; ghosts of single moving objects are not seen.
    """
    content = np.minimum(around(m.ghosting, np.min), _GHOST_CONTENT)
    return ramp(m.ghosting - content, _GHOST)


def unreliable_texture(m: Measures, texture: ArrayF64) -> ArrayF64:
    """b_unreliable_texture: fine detail lost, or drowned in noise."""
    return 1.0 - texture * decay(m.noise, _NOISE_HALF, 2.0)
