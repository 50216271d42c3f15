"""Estimation of a frame's formation with a scene.

The *residual* of a frame is its mean difference from the render (`comparison`). The *gain* of a missing
blur is the share of the squared error that it would explain (`pretest`). A *search* fits all models from
scratch (`search`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from cleargs.formation.comparison import MIN_RESIDUAL, FramePair, MotionFit, explained_share, luminance
from cleargs.formation.frame import FrameFormation, displacement_of, margin_for
from cleargs.formation.measured import MeasuredPath
from cleargs.formation.motion import FrameMotion, Model, widened
from cleargs.formation.pretest import MissingBlur, missing_blur
from cleargs.formation.search import blur_along, corrected, measured_fits, named, preferred, refine, search
from cleargs.formation.warp import Warp, displacement_fields, path_lengths
from cleargs.splat.backend import backend_for
from cleargs.splat.camera import Camera
from cleargs.splat.config import FormationConfig
from cleargs.splat.formation import Renderer
from cleargs.splat.kernels.warp_layout import CHANNELS, DisplacementFields
from cleargs.splat.types import Render
from cleargs.types import ArrayF64

SEARCH_GAIN, LOW_WEIGHT_GAIN = 0.015, 0.005
"""Gain of a missing blur above which a frame is searched. The second value is for frames with a low weight by
RVA. Both are from tuning captures (docs/experiments/formation.md)."""
MAX_RISE = 0.03
"""Limit of a check before a frame without a model is searched in a sharp capture: half of the blur that the
test found must not raise the residual by this share or more. Wrong geometry can look like blur in the test,
but blurring the render then makes it less like the frame (docs/experiments/formation.md)."""
CONTRADICTING_GAIN = 0.1
"""The same for a frame whose blur is a measured motion, if the shutter was measured too. No search of such a
frame, with gains of up to 0.07, found a better motion (docs/experiments/formation.md)."""
GROWN_GAIN = 1.25
"""Factor by which the gain must have grown since the last search before a frame is searched again."""
SEARCHED_SHARE = 0.05
"""Margin of a search, as a share of the longer side."""

EXPOSURES = np.geomspace(1 / 16, 3.0, 18)
"""Exposure times that are tried with a measured motion, in frames of the video."""

NEARER = np.array([0.85, 0.92, 1.0, 1.08, 1.17])
"""Exposure times that are tried around the best of these, as factors."""

SHORTEST = 1.0
"""Shortest mean blur of a measured motion, px of the full image. A blur of less than a pixel looks like the
softness of the render: sharp frames of rooms found 0.2 to 0.8 px, and the scene became too sharp."""


@dataclass(frozen=True)
class Shot:
    """A frame image at the size of a training step, and the scene that it shows."""

    camera: Camera
    """The camera of the frame, reduced by ``factor``."""
    affine: Tensor | None  # [3, 4] colour of the frame
    observed: Tensor  # [H, W, 3] sRGB
    mask: Tensor | None  # [H, W]
    render: Renderer
    """Renders the scene with depth."""
    factor: float = 1.0
    """Size of ``camera`` over that of the frame."""


@dataclass(frozen=True)
class Terms:
    """Facts about a frame and its capture on which an estimate depends."""

    pose: bool = False
    """Correct the pose together with a motion."""
    low_weight: bool = False
    """RVA gives the frame a low weight, so less blur is enough for a search."""
    shutter: Literal["global", "tested", "rolling"] = "global"
    """global: no model has a skew; tested: none, but the `FrameFormation.skew_gain` is measured."""
    curve: bool = False
    """Try a higher order of the path, and search a frame with a curved path or a rolling shutter."""
    only_if_blur_found: bool = False
    """Skip the first search unless the test finds a blur that `_Estimate._resembles` admits."""
    exposure_s: float = 0.0
    """Exposure time of the frames around this one, s; 0: it is not known."""
    measured: MeasuredPath | None = None
    """Motion that ingest measured. Its skew replaces all others, and its blur the first search."""


class Reason(Enum):
    """Reason for a search."""

    FIRST = "a scene that is still soft hides short blurs from the test"
    SHUTTER = "a skew must be found or tested, which the test cannot see"
    MODEL = "the model of the frame is no longer admitted"
    CURVE = "a descent with many unknowns that began in a soft scene can stay in a wrong path"
    BLUR = "the test finds blur that the model does not explain"


def fit_motion(
    frame: FrameFormation,  # the formation so far, whose model remains a candidate
    config: FormationConfig,
    shot: Shot,
    terms: Terms,
) -> FrameFormation:
    """Estimate how a frame image was taken, from the scene that it shows.

    The known formation is refined, or the measured motion is followed. The frame is searched only for a
    `Reason`.
    """
    estimate = _Estimate(frame, config, shot, terms)
    found = estimate.followed()
    best = estimate.accepted(found[1:] or found, found[0])
    missing = estimate.unexplained(best)
    if estimate.reason(found, best, missing) is None:
        # A search is rarely better than a measured motion, so it is not repeated for a small change.
        gain = frame.blur_gain if terms.measured is not None else min(frame.blur_gain, missing.gain)
        return estimate.described(best, gain)
    found = estimate.searched(found, best, missing)
    best = estimate.accepted(found, found[0])
    return estimate.described(best, estimate.unexplained(best).gain)


class _Estimate:
    """One estimate of a frame's formation, with the present scene."""

    def __init__(self, frame: FrameFormation, config: FormationConfig, shot: Shot, terms: Terms) -> None:
        self._frame, self._config, self._shot, self._terms = frame, config, shot, terms
        self._show(margin_for(frame.displacement_px * shot.factor, shot.camera))

    def _show(self, margin: int) -> None:
        """Render the scene with a margin."""
        shot, self._margin = self._shot, margin
        self._rendered = shot.render(widened(shot.camera, margin))
        self._pair = frame_pair(self._rendered, shot.affine, shot.observed, shot.mask, shot.camera, margin)

    @property
    def _known(self) -> FrameMotion:
        """The known motion, at the size of this estimate."""
        return _scaled(self._frame.motion, self._shot.factor)

    @property
    def _held(self) -> FrameMotion | None:
        """The measured skew, which all models have; None if no readout was measured."""
        measured = self._terms.measured
        if measured is None or not measured.rolls:
            return None
        return measured.read(self._shot.camera, self._pair.finest.median)

    def followed(self) -> list[MotionFit]:
        """Return the fit without blur and defocus, then those of the known or of the measured motion."""
        frame, terms, held = self._frame, self._terms, self._held
        if terms.measured is not None and not frame.searched:
            return [self._resting(), *filter(self._visible, self._measured(terms.measured))]
        if held is None:
            return refine(self._pair, frame.model, self._known, pose=terms.pose, curve=terms.curve)
        model: Model = "defocus" if frame.model == "defocus" else "blur"
        found = refine(self._pair, model, self._known, pose=terms.pose, curve=terms.curve)
        return [self._resting(), *(replace(fit, model=named(fit.model, fit.motion)) for fit in found[1:])]

    def _resting(self) -> MotionFit:
        """Return the fit without blur and defocus."""
        level, held = self._pair.finest, self._held
        if held is None:
            return level.evaluate("none", FrameMotion(median_depth=level.median))
        return level.evaluate("skew", held)

    def _measured(self, measured: MeasuredPath) -> list[MotionFit]:
        """Return fits of the measured motion, by the known exposure time or by the best of several."""
        known = self._known
        found: list[MotionFit] = []
        if known.exposure_s > 0.0:
            path = self._exposed(measured, known.exposure_s)
            if not known.bend.any():  # a straight path was preferred
                path = replace(path, bend=known.bend, cube=known.cube)
            path = replace(path, pose=known.pose, blur=known.blur, skew=known.skew)
            found.append(self._corrected(measured, path))
        if self._terms.exposure_s > 0.0:
            found += self._best_of(measured, np.array([self._terms.exposure_s]))
        if self._frame.steps == 0 or self._terms.curve:
            tried = [self._exposed(measured, float(time)) for time in EXPOSURES * measured.frame_s]
            best = min(tried, key=self._pair.finest.cost)  # half of the size is too coarse for short blurs
            found += self._best_of(measured, NEARER * best.exposure_s)
        return found

    def _best_of(self, measured: MeasuredPath, times: ArrayF64) -> list[MotionFit]:
        """Return fits of the measured motion during the exposure of ``times`` that explains most."""
        fits = measured_fits(self._pair, [self._exposed(measured, float(time)) for time in times])
        return [*fits, self._corrected(measured, min(fits, key=lambda fit: fit.residual).motion)]

    def _visible(self, fit: MotionFit) -> bool:
        """Return True if the mean blur of ``fit`` is not shorter than `SHORTEST`."""
        return _blur_of(fit.motion, self._pair, self._rendered) >= SHORTEST * self._shot.factor

    def _exposed(self, measured: MeasuredPath, seconds: float) -> FrameMotion:
        return measured.exposed(seconds, self._shot.camera, self._pair.finest.median)

    def _corrected(self, measured: MeasuredPath, path: FrameMotion) -> MotionFit:
        known = measured.measurement(path.exposure_s, self._shot.camera, path.median_depth)
        return corrected(self._pair, path, known, pose=self._terms.pose)

    def accepted(self, found: list[MotionFit], without: MotionFit) -> MotionFit:
        """Return the best of ``found`` that explains enough more than ``without``, else ``without``.

        The model that the frame had needs only half as much, and so does a measured motion. A measured motion
        during the exposure time of the frames around it must only explain no less.
        """
        best = preferred(found)
        if best.model == without.model:
            return min(best, without, key=lambda fit: fit.residual)
        known = best.model == self._frame.model or best.motion.exposure_s > 0.0
        gain = explained_share(best.residual, without.residual)
        if gain >= self._config.accept * (0.5 if known else 1.0):
            return best
        alike = [fit for fit in found if 0.0 < fit.motion.exposure_s == self._terms.exposure_s]
        exposed = min(alike, key=lambda fit: fit.residual, default=without)
        return exposed if exposed.residual <= without.residual else without

    def unexplained(self, fit: MotionFit) -> MissingBlur:
        """Return the blur of the frame that is missing in the render after the image formation of ``fit``."""
        return _unexplained(self._pair, self._rendered, fit)

    def reason(self, found: list[MotionFit], best: MotionFit, missing: MissingBlur) -> Reason | None:
        """Return the reason to search the frame; None if there is none."""
        frame, terms, rolls = self._frame, self._terms, self._terms.shutter == "rolling"
        if terms.measured is None:
            # A formation that was found under the other assumption about the shutter is searched again.
            unmeasured = frame.skew_gain is None or frame.skew_gain > self._config.accept
            if terms.shutter == "tested" or (rolls and unmeasured and _admitted(frame.model, rolling=False)):
                return Reason.SHUTTER
            if frame.steps == 0 and not terms.only_if_blur_found:
                return Reason.FIRST
            if not _admitted(frame.model, rolls):
                return Reason.MODEL
            if terms.curve and (rolls or preferred(found[1:] or found).motion.order > 1):
                return Reason.CURVE
        enough = max(LOW_WEIGHT_GAIN if terms.low_weight else SEARCH_GAIN, GROWN_GAIN * frame.blur_gain)
        if best.motion.exposure_s > 0.0 and terms.measured is not None and terms.measured.rolls:
            enough = max(enough, CONTRADICTING_GAIN)
        blurred = missing.gain > enough and best.residual > MIN_RESIDUAL
        known = best.model not in ("none", "skew")
        if blurred and (known or not terms.only_if_blur_found or self._resembles(missing)):
            return Reason.BLUR
        return None

    def _resembles(self, missing: MissingBlur) -> bool:
        """Return True unless half of the missing blur raises the residual too much (`MAX_RISE`)."""
        level = self._pair.finest
        blur = replace(blur_along(0.5 * missing.length, missing.angle), median_depth=level.median)
        return level.evaluate("blur", blur).explained > -MAX_RISE

    def searched(self, followed: list[MotionFit], best: MotionFit, missing: MissingBlur) -> list[MotionFit]:
        """Return the fits of a search, the one without blur first, with that of the followed motion."""
        camera, terms = self._shot.camera, self._terms
        wide = margin_for(SEARCHED_SHARE * max(camera.width, camera.height), camera)
        if wide > self._margin:
            self._show(wide)
        resting = self._resting() if self._held is not None else followed[0]
        whole = missing if best.model == resting.model else self.unexplained(resting)
        skews = terms.shutter != "global" and terms.measured is None
        found = search(
            self._pair,
            start=None if skews else blur_along(whole.length, whole.angle),
            skew=skews,
            defocus=terms.shutter == "rolling" or whole.disc_gain > whole.line_gain,
            pose=terms.pose,
            held=self._held,
        )
        if skews:
            self._frame = replace(self._frame, skew_gain=_skew_gain(found))
        known = preferred(followed[1:] or followed)
        if known.model not in ("none", "skew") or (known.model == "skew" and self._held is None):
            motion, model = known.motion, known.model
            if motion.exposure_s > 0.0 or self._held is not None:
                found.append(self._pair.finest.evaluate(model, motion))
            else:
                found += refine(self._pair, model, motion, pose=terms.pose)[1:]
        rolls = terms.shutter == "rolling" or self._held is not None
        return [fit for fit in found if _admitted(fit.model, rolls)]

    def described(self, best: MotionFit, gain: float) -> FrameFormation:
        """Return the frame with its new fit and the gain of a missing blur."""
        frame, shot = replace(self._frame, blur_gain=gain), self._shot
        return _described(frame, best, shot.factor, shot.camera, self._rendered, self._margin)


def _blur_of(motion: FrameMotion, pair: FramePair, rendered: Render) -> float:
    """Return the mean length of the pixels' paths during the exposure, px of ``pair``."""
    assert rendered.depth is not None
    fields = displacement_fields(motion, pair.camera, rendered.depth, rendered.alpha, pair.margin)
    return float(path_lengths(fields, 4).mean(dtype=np.float64))


def _unexplained(pair: FramePair, rendered: Render, fit: MotionFit) -> MissingBlur:
    """Return the blur of the frame that is missing in the render after the image formation of ``fit``."""
    shown = pair.luminance
    if fit.model != "none":
        assert rendered.depth is not None
        fields = displacement_fields(fit.motion, pair.camera, rendered.depth, rendered.alpha, pair.margin)
        light = np.repeat(pair.luminance[..., None], CHANNELS, axis=2)
        exposed = Warp.of(fields, pair.margin).forward(torch.from_numpy(light).to(rendered.depth.device))
        shown = exposed[..., 0].cpu().numpy()
    elif pair.margin:
        shown = shown[pair.margin : -pair.margin, pair.margin : -pair.margin]
    return missing_blur(np.ascontiguousarray(shown), pair.observed, pair.weight)


def _admitted(model: Model, rolling: bool) -> bool:
    return rolling or model not in ("skew", "both")


def _skew_gain(found: list[MotionFit]) -> float:
    """Return the share by which the best model with a skew reduces the residual of the best one without."""
    without = preferred([e for e in found if _admitted(e.model, rolling=False)])
    rolled = preferred([e for e in found if not _admitted(e.model, rolling=False)])
    return max(0.0, explained_share(rolled.residual, without.residual))


def frame_pair(
    rendered: Render,
    affine: Tensor | None,
    observed: Tensor,
    mask: Tensor | None,
    camera: Camera,
    margin: int,
) -> FramePair:
    """Return the images that a search compares. Masked pixels of the frame show the render."""
    assert rendered.depth is not None
    image = rendered.image
    if affine is not None:
        image = backend_for(image.device).apply_affine(image, affine)
    shown, seen = image.clamp(0.0, 1.0).cpu().numpy(), observed.cpu().numpy()
    counts = np.ones(seen.shape[:2], np.bool_) if mask is None else mask.cpu().numpy()
    inner = shown[margin : margin + camera.height, margin : margin + camera.width]
    return FramePair(
        luminance(shown),
        rendered.depth.cpu().numpy(),
        rendered.alpha.cpu().numpy(),
        luminance(np.where(counts[..., None], seen, inner)),
        counts.astype(np.float32),
        camera,
        margin,
    )


def _described(
    frame: FrameFormation, best: MotionFit, factor: float, camera: Camera, rendered: Render, margin: int
) -> FrameFormation:
    """Return the frame with a new fit; lengths are in pixels of the full image."""
    if best.model == "none":
        return FrameFormation(
            frame.frame_id,
            FrameMotion(median_depth=best.motion.median_depth),
            residual=best.residual,
            residual_without=best.residual_without,
            skew_gain=frame.skew_gain,
            blur_gain=frame.blur_gain,
            steps=frame.steps,
        )
    motion = _scaled(best.motion, 1.0 / factor)
    depth, alpha = rendered.depth, rendered.alpha
    assert depth is not None

    def fields(of: FrameMotion) -> DisplacementFields:
        return displacement_fields(of, camera, depth, alpha, margin, factor)

    whole, turned = fields(motion), fields(FrameMotion(blur=motion.skew, median_depth=motion.median_depth))
    return replace(
        frame,
        motion=motion,
        model=best.model,
        residual=best.residual,
        residual_without=best.residual_without,
        blur_px=float(path_lengths(whole).mean(dtype=np.float64)) / factor,
        skew_px=float(path_lengths(turned).mean(dtype=np.float64)) / factor,
        defocus_px=float(whole.radius.cpu().numpy().mean(dtype=np.float64)) / factor,
        displacement_px=displacement_of(whole) / factor,
    )


def _scaled(motion: FrameMotion, factor: float) -> FrameMotion:
    if factor == 1.0:
        return motion
    return replace(motion.with_vector(factor * motion.vector), disc_px=factor * motion.disc_px)
