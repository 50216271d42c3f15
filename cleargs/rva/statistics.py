"""The default evaluator: the eleven cues from image statistics and from neighbouring frames of the video.

First each frame is measured separately (`measure`). Then its measures are compared with those of its
neighbours (`cues_from_measures`): one image does not show if it is blurred or if its content is soft, but
neighbours show almost the same content. Response curves map raw measures to cues in [0, 1].

Choice of the blur constants: a frame should reach the paper's R >= 0.70 if full weight in training does no
harm. This was measured on two synthetic captures of 320x180 px with a motion blur of L px in half of the
frames (docs/experiments/rva.md). Compared with a weight of 0.4, full weight is better in PSNR and SSIM at
L = 2.5 and worse at L = 4. The mean R is 0.82 at 2.5 px, 0.67 at 4 px and 0.54 at 6 px.
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
from cleargs.rva.measures import DIRECTIONS, Luminance, blur_sigmas, detail_ratios, reduce_luminance
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.types import ArrayF64

# Sigmas are standard deviations of the blur in px of the reduced image. Luma is in [0, 1] unless levels are
# stated.
_NEIGHBOURS = 4  # frames before and after; the sharpest of them shows the detail of the content
# Bounds of the content's detail ratio. Lower: step edges, so that soft neighbours do not excuse a frame.
# Upper: rich texture; a neighbour with more shows other content.
_CONTENT_DETAIL = (3.0, 5.0)
_SHARPNESS_HALF = 0.8  # largest sigma over the directions at which r_sharpness is 1/2
_STRUCTURE_HALF = 0.7  # mean sigma over the directions at which r_structure is 1/2
_STEEPNESS = 3.0  # exponent of the blur curves
_NOTICEABLE = 0.5  # sigma that sharp frames reach by their content alone
_MOTION_HALF = 1.2  # largest visible sigma at which b_motion_blur is 1/2
_DEFOCUS_HALF = 1.2  # smallest visible sigma at which b_defocus is 1/2
_ISOTROPY = (0.80, 0.92)  # smallest sigma divided by the largest: of motion blur, of a disc
_DETAIL = (0.10, 1.0)  # share of the content's fine detail at which r_texture is 0, 1
_CONTRAST = (0.02, 0.10)  # spread of luma at which texture is unreliable, reliable
_NOISE_HALF = 8.0  # noise, levels of 255, at which r_cleanness is 1/2
_BLOCKING_HALF = 4.0  # blocking at which b_artifacts is 1/2; videos of good quality stay below 2
_RINGING_HALF = 10.0  # ringing, levels of 255, at which b_artifacts is 1/2
_GHOST_CONTENT = 0.10  # largest cepstral side peak that content can explain
_GHOST = (0.04, 0.16)  # excess of the side peak at which b_ghosting is 0, 1
_CLIPPED = (0.10, 0.50)  # share of clipped pixels above the least clipped neighbour's: harmless, failure
_DARK = (0.20, 0.04)  # mean luma: harmless, failure
_BRIGHT = (0.70, 0.95)  # mean luma: harmless, failure
_STOPS = (0.4, 2.0)  # stops between the mean luma and the neighbours' median: harmless, failure


def ramp(value: ArrayF64, ends: tuple[float, float]) -> ArrayF64:
    """Return 0 at the first end, 1 at the second, linear between, clipped. The second end may be smaller."""
    return np.clip((value - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)


def decay(value: ArrayF64, half: float, steepness: float) -> ArrayF64:
    """Return 1 / (1 + (value / half)^steepness): 1 at 0, 1/2 at ``half``."""
    return np.asarray(1.0 / (1.0 + (value / half) ** steepness))


@dataclass(frozen=True)
class Measures:
    """Raw measures of n frames, in trajectory order."""

    detail: ArrayF64  # [n, DIRECTIONS] ratios of measures.detail_ratios
    noise: ArrayF64  # [n] levels of 255
    blocking: ArrayF64  # [n]
    ringing: ArrayF64  # [n] levels of 255
    ghosting: ArrayF64  # [n] height of a cepstral peak
    mean: ArrayF64  # [n] luma in [0, 1]
    clipped: ArrayF64  # [n] share of the pixels
    spread: ArrayF64  # [n] 95th less 5th percentile of luma, in [0, 1]


MEASURE_COLUMNS = (
    *(f"detail_{k}" for k in range(DIRECTIONS)),
    *(field.name for field in fields(Measures) if field.name != "detail"),
)
"""Names of the numbers in a row of `measure`."""


def measure(luminance: Luminance) -> ArrayF64:
    """Return all raw measures of one frame, in the order of `MEASURE_COLUMNS`."""
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
    """Evaluator ``statistics``. It uses no neural network."""

    name = "statistics"
    version = 2

    def __init__(self, cache: Path | None = None) -> None:
        """Use ``cache`` as the folder for the measures of single frames; None: no cache."""
        self._cache = ItemCache(cache, MEASURE_COLUMNS, [self.name, self.version, cv2.__version__])

    def evaluate(self, views: Sequence[EvaluatedFrame], *, threads: int, reporter: Reporter) -> ArrayF64:
        """Measure all frames and compare them with their neighbours; see `Evaluator.evaluate`.

        Raises StoreError if an image is unreadable.
        """
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
    """Return the cues in the order of `tables.CUE_COLUMNS`.

    ``rows`` are those of `measure` [n, measures], in trajectory order.
    """
    m = Measures(rows[:, :DIRECTIONS], *rows[:, DIRECTIONS:].T)
    content = content_detail(m)
    sigmas = blur_sigmas(m.detail, content)
    texture = texture_reliability(m, content)
    exposed = exposure_quality(m)
    loss = 1.0 - exposed
    noiseless = decay(m.noise, _NOISE_HALF, 2.0)
    intact = decay(m.blocking, _BLOCKING_HALF, 2.0) * decay(m.ringing, _RINGING_HALF, 2.0)
    cues = {
        "r_sharpness": decay(sigmas.max(axis=1), _SHARPNESS_HALF, _STEEPNESS),
        # The mean: motion does not blur edges parallel to it, so that it costs less than equal defocus.
        "r_structure": decay(sigmas.mean(axis=1), _STRUCTURE_HALF, _STEEPNESS),
        "r_texture": texture,
        "r_cleanness": intact * noiseless,
        "r_exposure": exposed,
        "b_motion_blur": motion_blur(sigmas),
        "b_defocus": defocus(sigmas),
        "b_ghosting": ghosting(m),
        "b_exposure_failure": loss * loss * (3.0 - 2.0 * loss),  # small losses count less
        "b_unreliable_texture": 1.0 - texture * noiseless,
        "b_artifacts": 1.0 - intact,
    }
    return np.stack([cues[name] for name in CUE_COLUMNS], axis=1)


def over_neighbours(values: ArrayF64, pick: Callable[..., ArrayF64]) -> ArrayF64:  # [n, ...] -> [n, ...]
    """Apply ``pick`` (np.min, np.max, np.median) to each frame with up to _NEIGHBOURS on either side."""
    spans = [slice(max(0, i - _NEIGHBOURS), i + _NEIGHBOURS + 1) for i in range(len(values))]
    return np.stack([pick(values[span], axis=0) for span in spans])


def content_detail(m: Measures) -> ArrayF64:  # [n, DIRECTIONS]
    """Estimate the detail ratio of the content if it were sharp.

    This is the largest ratio of the neighbours per direction, within _CONTENT_DETAIL. Failure modes: after a
    cut, or with few frames per metre, neighbours show other content (the upper bound limits the error); in a
    capture that is blurred throughout all neighbours are blurred (the lower bound limits the error).
    """
    return np.clip(over_neighbours(m.detail, np.max), *_CONTENT_DETAIL)


def texture_reliability(m: Measures, content: ArrayF64) -> ArrayF64:
    """Return r_texture: the share of the content's fine detail that is kept, lower for little contrast.

    Detail is the ratio of `measures.detail_ratios` above 1, the ratio of a fully blurred image. Failure modes
    are those of `content_detail`.
    """
    kept = (m.detail.mean(axis=1) - 1.0) / (content.mean(axis=1) - 1.0)
    return ramp(kept, _DETAIL) * ramp(m.spread, _CONTRAST)


def exposure_quality(m: Measures) -> ArrayF64:
    """Return r_exposure: not clipped, dark or bright, and as bright as the neighbours.

    Only clipping above that of the least clipped neighbour counts, since a visible window or lamp is content.
    Failure mode: in a capture that is badly exposed throughout only the mean luma shows it.
    """
    clipped = ramp(m.clipped - np.minimum(over_neighbours(m.clipped, np.min), 0.5), _CLIPPED)
    level = np.maximum(m.mean, 1.0 / 255.0)
    stops = np.abs(np.log2(level / over_neighbours(level, np.median)))
    tonal = np.maximum(ramp(m.mean, _DARK), ramp(m.mean, _BRIGHT))
    return (1.0 - clipped) * (1.0 - tonal) * (1.0 - ramp(stops, _STOPS))


def isotropy(sigmas: ArrayF64) -> ArrayF64:
    """Return 1 for the blur of a disc and 0 for that of a motion, from smallest and largest sigma."""
    return ramp(sigmas.min(axis=1) / np.maximum(sigmas.max(axis=1), 1e-9), _ISOTROPY)


def visible_blur(sigmas: ArrayF64, half: float) -> ArrayF64:
    """Return 0 for blur that content can explain, 1/2 at ``half`` px more, as a difference of variances."""
    visible = np.sqrt(np.maximum(sigmas**2 - _NOTICEABLE**2, 0.0))
    return 1.0 - decay(visible, half, _STEEPNESS)


def motion_blur(sigmas: ArrayF64) -> ArrayF64:
    """Return b_motion_blur: the visible blur in the worst direction, if directions differ.

    Failure modes: rotation about the optical axis or a curved path blurs all directions and looks like
    defocus; a moving object in a sharp scene counts only if it has much of the frame's detail.
    """
    return (1.0 - isotropy(sigmas)) * visible_blur(sigmas.max(axis=1), _MOTION_HALF)


def defocus(sigmas: ArrayF64) -> ArrayF64:
    """Return b_defocus: the visible blur in the best direction, if directions are alike.

    Failure modes are those of `motion_blur`.
    """
    return isotropy(sigmas) * visible_blur(sigmas.min(axis=1), _DEFOCUS_HALF)


def ghosting(m: Measures) -> ArrayF64:
    """Return b_ghosting (a double image of the whole frame): the cepstral side peak above the neighbours'.

    Failure modes: those of `measures.ghosting`; ghosts of single moving objects are missed.
    `cleargs.rva.hidden` finds objects that hide the scene.
    """
    content = np.minimum(over_neighbours(m.ghosting, np.min), _GHOST_CONTENT)
    return ramp(m.ghosting - content, _GHOST)
