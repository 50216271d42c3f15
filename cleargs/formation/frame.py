"""Image formation of one frame, and its estimation with a scene.

The *misfit* of a frame is its mean difference from the render (`comparison`). *Evidence* is the share of the
squared error that further blur would explain (`pretest`). A *search* fits all models from scratch (`search`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.formation.comparison import (
    MIN_MISFIT,
    FramePair,
    MotionFit,
    explained_share,
    finest_level,
    luminance,
)
from cleargs.formation.motion import MODELS, TWISTS, FrameMotion, Model, widened
from cleargs.formation.pretest import BlurEvidence, blur_evidence
from cleargs.formation.search import blur_along, preferred, refine, search
from cleargs.formation.warp import Warp, displacement_fields, path_lengths
from cleargs.splat.backend import backend_for
from cleargs.splat.camera import Camera
from cleargs.splat.config import FormationConfig
from cleargs.splat.formation import Renderer
from cleargs.splat.kernels.warp_layout import BEND_REACH, CHANNELS, CUBE_REACH, DisplacementFields
from cleargs.splat.types import Render

EVIDENCE, DOUBTED_EVIDENCE = 0.015, 0.005
"""Evidence of blur above which a frame is searched. The second value is for frames that RVA doubts. Both are
from tuning captures (docs/experiments/formation.md)."""
WORSE = -0.03
"""Threshold of a check before a frame without a model is searched in a sharp capture: half of the blur that
the test found must not raise the misfit by 3 % or more. Wrong geometry can look like blur in the test, but
blurring the render then makes it less like the frame (docs/experiments/formation.md)."""
GROWN_EVIDENCE = 1.25
"""Factor by which the evidence must have grown since the last search before a frame is searched again."""
SEARCHED_SHARE = 0.05
"""Margin of a search, as a share of the longer side."""

MARGIN_STEP = 4
"""Margins are multiples of this, px."""
MARGIN_SHARE = 0.25
"""Largest margin, as a share of the shorter side."""

LENS = ("disc_px", "focus", "median_depth")
MEASURED = ("misfit", "misfit_still", "blur_px", "skew_px", "defocus_px", "reach_px")
"""Fields of a frame's motion in addition to its twists, and of the frame, in checkpoints and tables."""
AXES = ("tx", "ty", "tz", "rx", "ry", "rz")


@dataclass(frozen=True)
class FrameFormation:
    """The current estimate of a frame's formation. Lengths are in pixels of the full image."""

    frame_id: int
    motion: FrameMotion = field(default_factory=FrameMotion)
    model: Model = "none"
    misfit: float = 0.0
    """Mean difference of high-passed linear luminance that the model leaves, see `comparison.MotionFit`."""
    misfit_still: float = 0.0
    blur_px: float = 0.0
    """Mean length of the pixels' paths during the exposure."""
    skew_px: float = 0.0
    """Mean length of the pixels' paths from the first to the last row's exposure."""
    defocus_px: float = 0.0
    """Mean radius of the discs of defocus."""
    reach_px: float = 0.0
    """Largest displacement of a pixel's samples along an axis: the 95th percentile over the pixels."""
    skew_gain: float | None = None
    """Share of the misfit that a rolling shutter explains beyond blur and defocus, by the last search that
    tried one; None if none did."""
    evidence: float = 0.0
    """Least evidence of further blur since the last search."""
    draws: int = 0
    """Training steps on the frame since the first estimate of its formation."""

    @property
    def explained(self) -> float:
        """Share of the misfit that the model removes."""
        return explained_share(self.misfit, self.misfit_still)


def described(frame: FrameFormation) -> str:
    """Return the formation in a few words: ``blur 5.2 px, skew 1.4 px``."""
    lengths = {"blur": frame.blur_px, "skew": frame.skew_px, "defocus": frame.defocus_px}
    parts = ("blur", "skew") if frame.model == "both" else (frame.model,)
    return ", ".join(f"{part} {lengths[part]:.1f} px" for part in parts if part in lengths) or "nothing"


def fit_motion(
    frame: FrameFormation,  # the formation so far, whose model remains a candidate
    config: FormationConfig,
    camera: Camera,  # the frame's, reduced by ``factor``
    affine: Tensor | None,  # [3, 4] colour of the frame
    target: Tensor,  # [H, W, 3] sRGB, the frame
    mask: Tensor | None,  # [H, W]
    render: Renderer,  # renders the scene with depth
    *,
    factor: float = 1.0,  # size of ``camera`` over that of the frame
    pose: bool = False,  # correct the pose together with a motion
    doubted: bool = False,  # RVA doubts the frame, so less evidence is needed for a search
    rolling: bool = False,  # admit models with a skew
    test_rolling: bool = False,  # measure `skew_gain` even where no such model is admitted
    again: bool = False,  # try a higher order, and search a frame with a curved path or a rolling shutter
    sparing: bool = False,  # also the first time, search only for a blur that the test and `_resembled` admit
) -> FrameFormation:
    """Estimate how a raw frame was taken, from the scene that ``render`` shows.

    The known formation is refined. The first time, the frame is also searched. Later it is searched only if
    the test of `pretest` finds blur that the model does not explain and that the last search did not leave,
    or if a rolling shutter must be tested, since that test cannot detect a skew.
    """
    # A formation that was found under the other assumption about the shutter is searched again.
    unmeasured = frame.skew_gain is None or frame.skew_gain > config.accept
    untested = rolling and _admitted(frame.model, rolling=False) and unmeasured
    margin = margin_for(frame.reach_px * factor, camera)
    rendered = render(widened(camera, margin))
    pair = frame_pair(rendered, affine, target, mask, camera, margin)
    known = _scaled(frame.motion, factor)
    found = refine(pair, frame.model, known, pose=pose, curve=again)
    followed = preferred(found[1:] or found)
    best = _accepted(followed, found[0], frame.model, config)
    evidence = _unexplained(pair, rendered, best)
    skews = rolling or test_rolling
    first = frame.draws == 0 and not sparing  # a scene that is still soft hides short blurs from the test
    # A descent with many unknowns that began in a soft scene can end in a wrong path and stay there.
    again = again and (rolling or followed.motion.order > 1)
    asked = first or untested or test_rolling or again or not _admitted(frame.model, rolling)
    enough = max(DOUBTED_EVIDENCE if doubted else EVIDENCE, GROWN_EVIDENCE * frame.evidence)
    left = min(frame.evidence, evidence.gain)
    blurred = evidence.gain > enough and best.misfit > MIN_MISFIT
    if asked or (blurred and (best.model != "none" or not sparing or _resembled(pair, evidence))):
        wide = margin_for(SEARCHED_SHARE * max(camera.width, camera.height), camera)
        if wide > margin:
            margin, rendered = wide, render(widened(camera, wide))
            pair = frame_pair(rendered, affine, target, mask, camera, margin)
        whole = evidence if best.model == "none" else _unexplained(pair, rendered, found[0])
        found = search(
            pair,
            start=None if skews else blur_along(whole.length, whole.angle),
            skew=skews,
            defocus=rolling or whole.disc_gain > whole.line_gain,
            pose=pose,
        )
        if skews:
            frame = replace(frame, skew_gain=_skew_gain(found))
        if followed.model != "none":
            found += refine(pair, followed.model, followed.motion, pose=pose)[1:]
        best = preferred([e for e in found if _admitted(e.model, rolling)])
        best = _accepted(best, found[0], frame.model, config)
        left = _unexplained(pair, rendered, best).gain
    return _described(replace(frame, evidence=left), best, factor, camera, rendered, margin)


def _accepted(best: MotionFit, still: MotionFit, before: Model, config: FormationConfig) -> MotionFit:
    """Return ``best`` if it explains enough, else ``still``. The model ``before`` needs only half as much."""
    return best if best.explained >= config.accept * (0.5 if best.model == before else 1.0) else still


def _unexplained(pair: FramePair, rendered: Render, fit: MotionFit) -> BlurEvidence:
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
    return blur_evidence(np.ascontiguousarray(shown), pair.observed, pair.weight)


def _resembled(pair: FramePair, evidence: BlurEvidence) -> bool:
    """Return True unless half of the blur that the test found raises the misfit too much (`WORSE`)."""
    level = finest_level(pair)
    blur = replace(blur_along(0.5 * evidence.length, evidence.angle), median_depth=level.median)
    return level.evaluate("blur", blur).explained > WORSE


def _admitted(model: Model, rolling: bool) -> bool:
    return rolling or model not in ("skew", "both")


def _skew_gain(found: list[MotionFit]) -> float:
    """Return the share by which the best model with a skew reduces the misfit of the best one without."""
    still = preferred([e for e in found if _admitted(e.model, rolling=False)])
    rolled = preferred([e for e in found if not _admitted(e.model, rolling=False)])
    return max(0.0, explained_share(rolled.misfit, still.misfit))


def frame_pair(
    rendered: Render, affine: Tensor | None, target: Tensor, mask: Tensor | None, camera: Camera, margin: int
) -> FramePair:
    """Return the images that a search compares. Masked pixels of the frame show the render."""
    assert rendered.depth is not None
    image = rendered.image
    if affine is not None:
        image = backend_for(image.device).apply_affine(image, affine)
    shown, seen = image.clamp(0.0, 1.0).cpu().numpy(), target.cpu().numpy()
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
            misfit=best.misfit,
            misfit_still=best.misfit_still,
            skew_gain=frame.skew_gain,
            evidence=frame.evidence,
            draws=frame.draws,
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
        misfit=best.misfit,
        misfit_still=best.misfit_still,
        blur_px=float(path_lengths(whole).mean(dtype=np.float64)) / factor,
        skew_px=float(path_lengths(turned).mean(dtype=np.float64)) / factor,
        defocus_px=float(whole.radius.cpu().numpy().mean(dtype=np.float64)) / factor,
        reach_px=reach_of(whole) / factor,
    )


def reach_of(fields: DisplacementFields) -> float:
    """Return the reach of the pixels, px: see `FrameFormation.reach_px`."""
    few = (..., slice(None, None, 4), slice(None, None, 4))
    displacements = fields.offset[few].abs() + 0.5 * fields.sweep[few].abs() + fields.radius[few]
    if fields.curve is not None:
        curve = fields.curve[few].abs()
        displacements += BEND_REACH * curve[:2] + CUBE_REACH * curve[2:]
    return float(np.quantile(displacements.amax(dim=0).cpu().numpy(), 0.95))


def _scaled(motion: FrameMotion, factor: float) -> FrameMotion:
    if factor == 1.0:
        return motion
    return replace(motion.with_vector(factor * motion.vector), disc_px=factor * motion.disc_px)


def margin_for(reach: float, camera: Camera) -> int:
    """Return the margin, px, that contains the pixels that moved in from outside the border."""
    largest = int(MARGIN_SHARE * min(camera.width, camera.height)) // MARGIN_STEP * MARGIN_STEP
    return min(largest, MARGIN_STEP * math.ceil(reach / MARGIN_STEP)) if reach >= 0.5 else 0


def as_row(frame: FrameFormation) -> dict[str, Any]:
    """Return the numbers of the frame by their names in ``formation.parquet``."""
    motion = frame.motion
    row: dict[str, Any] = {name: getattr(frame, name) for name in ("frame_id", "model", "draws", "evidence")}
    for name in TWISTS:
        row |= {f"{name}_{axis}": float(v) for axis, v in zip(AXES, getattr(motion, name), strict=True)}
    row |= {name: getattr(motion, name) for name in LENS} | {"order": motion.order}
    return row | {name: getattr(frame, name) for name in (*MEASURED, "skew_gain")}


def from_row(row: Mapping[str, Any]) -> FrameFormation:
    """Return the frame of a row from `as_row`. Older tables lack ``draws``, curves and ``evidence``."""
    vector = np.array([row.get(f"{name}_{axis}") or 0.0 for name in TWISTS for axis in AXES])
    return FrameFormation(
        row["frame_id"],
        FrameMotion(**{name: row[name] for name in LENS}).with_vector(vector),
        row["model"],
        evidence=row.get("evidence") or 0.0,
        draws=row.get("draws") or 0,
        **{name: row[name] for name in (*MEASURED, "skew_gain")},
    )


def packed(frames: Iterable[FrameFormation]) -> NDArray[np.float64]:
    """Return the frames as one row of numbers each, for a checkpoint."""
    rows = []
    for frame in frames:
        gain = -1.0 if frame.skew_gain is None else frame.skew_gain
        row = as_row(frame) | {"model": MODELS.index(frame.model), "skew_gain": gain}
        rows.append(list(row.values()))
    return np.array(rows, np.float64).reshape(len(rows), len(as_row(FrameFormation(0))))


def unpacked(numbers: NDArray[np.float64]) -> Iterator[FrameFormation]:
    """Yield the frames in the result of `packed`."""
    names = tuple(as_row(FrameFormation(0)))
    for row in (dict(zip(names, values, strict=True)) for values in numbers.tolist()):
        gain = None if row["skew_gain"] < 0.0 else row["skew_gain"]
        counts = {name: int(row[name]) for name in ("frame_id", "draws")}
        yield from_row(row | counts | {"model": MODELS[int(row["model"])], "skew_gain": gain})
