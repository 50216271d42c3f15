"""How one frame was taken: what is known of it, and estimating it again in the light of a scene."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from cleargs.formation.comparison import FramePair, MotionFit, explained_share, luminance
from cleargs.formation.exposure import apply_affine
from cleargs.formation.motion import MODELS, TWIST, FrameMotion, Model, widened
from cleargs.formation.search import preferred, refine, search
from cleargs.formation.warp import displacement_fields
from cleargs.splat.backend import backend_for
from cleargs.splat.camera import Camera
from cleargs.splat.config import FormationConfig
from cleargs.splat.formation import Renderer
from cleargs.splat.kernels.warp_layout import DisplacementFields
from cleargs.splat.types import Render

MARGIN_STEP = 4
"""Margins are multiples of this, px."""
MARGIN_SHARE = 0.25
"""Largest margin, as a share of the shorter side."""

LENS = ("disc_px", "focus", "median_depth")
MEASURED = ("misfit", "misfit_still", "blur_px", "skew_px", "defocus_px", "reach_px")
"""Numbers of a frame's motion beyond its twists, and of the frame, as checkpoints and tables hold them."""
TWISTS, AXES = ("pose", "blur", "skew"), ("tx", "ty", "tz", "rx", "ry", "rz")


@dataclass(frozen=True)
class FrameFormation:
    """What is known of how one frame was taken."""

    frame_id: int
    motion: FrameMotion = field(default_factory=FrameMotion)
    model: Model = "none"
    misfit: float = 0.0
    """Mean difference of high-passed linear luminance that the model leaves, see `comparison.MotionFit`."""
    misfit_still: float = 0.0
    blur_px: float = 0.0
    """Mean length of the pixels' paths while they were exposed."""
    skew_px: float = 0.0
    """Mean length of their paths from the first to the last row's exposure."""
    defocus_px: float = 0.0
    """Mean radius of the discs."""
    reach_px: float = 0.0
    """Farthest that a pixel looks from its place (95 % of them look less far)."""
    skew_gain: float | None = None
    """Share of the misfit that a rolling shutter explains beyond blur and defocus, by the last search; None
    where none was made."""
    draws: int = 0
    """Steps that were taken on the frame since its formation is looked for."""

    @property
    def explained(self) -> float:
        """Share of the misfit that the model takes away."""
        return explained_share(self.misfit, self.misfit_still)


def described(frame: FrameFormation) -> str:
    """In a few words: ``blur 5.2 px, skew 1.4 px``."""
    lengths = {"blur": frame.blur_px, "skew": frame.skew_px, "defocus": frame.defocus_px}
    parts = ("blur", "skew") if frame.model == "both" else (frame.model,)
    return ", ".join(f"{part} {lengths[part]:.1f} px" for part in parts if part in lengths) or "nothing"


def fit_motion(
    frame: FrameFormation,
    config: FormationConfig,
    camera: Camera,
    affine: Tensor | None,
    target: Tensor,
    mask: Tensor | None,
    render: Renderer,
    *,
    factor: float = 1.0,
    warm: bool = False,
    rolling: bool = False,
    test_rolling: bool = False,
) -> FrameFormation:
    """How a raw frame was taken, in the light of the scene that ``render`` shows.

    Args:
        frame: what is known already; its model stays in the race.
        camera: of the frame, reduced by ``factor``.
        affine: the frame's colour, [3, 4].
        target, mask: the frame, [H, W, 3] sRGB and [H, W].
        warm: refine what is known instead of searching among all models.
        rolling: whether models with a skew are in the race.
        test_rolling: whether to tell, where they are not, what such a model would explain (`skew_gain`).
    """
    # What was found under the other belief about the shutter is searched for anew.
    unmeasured = frame.skew_gain is None or frame.skew_gain > config.accept
    untested = rolling and _admitted(frame.model, rolling=False) and unmeasured
    warm = warm and _admitted(frame.model, rolling) and not untested
    # The motions that a search will find are not known yet.
    reach = frame.reach_px * factor if warm else 0.05 * max(camera.width, camera.height)
    margin = margin_for(reach, camera)
    rendered = render(widened(camera, margin))
    pair = frame_pair(rendered, affine, target, mask, camera, margin)
    known, kernels = _scaled(frame.motion, factor), backend_for(rendered.image.device)
    if warm:
        found = refine(pair, frame.model, known, pose=config.pose, kernels=kernels)
        best = found[-1]
    else:
        found = search(pair, skew=rolling or test_rolling, pose=config.pose, kernels=kernels)
        frame = replace(frame, skew_gain=_skew_gain(found) if rolling or test_rolling else None)
        if frame.model != "none":
            found += refine(pair, frame.model, known, pose=config.pose, kernels=kernels)[1:]
        best = preferred([e for e in found if _admitted(e.model, rolling)])
    # Hysteresis: what was taken before may stay at half the gain that lets a model in.
    if best.explained < config.accept * (0.5 if frame.model == best.model else 1.0):
        best = found[0]
    return _described(frame, best, factor, camera, rendered, margin)


def _admitted(model: Model, rolling: bool) -> bool:
    return rolling or model not in ("skew", "both")


def _skew_gain(found: list[MotionFit]) -> float:
    """Share of the misfit that is left without a skew and goes with one."""
    still = preferred([e for e in found if _admitted(e.model, rolling=False)])
    rolled = preferred([e for e in found if not _admitted(e.model, rolling=False)])
    return max(0.0, explained_share(rolled.misfit, still.misfit))


def frame_pair(
    rendered: Render, affine: Tensor | None, target: Tensor, mask: Tensor | None, camera: Camera, margin: int
) -> FramePair:
    """What a search compares: masked pixels of the frame show the render."""
    assert rendered.depth is not None
    image = rendered.image if affine is None else apply_affine(rendered.image, affine)
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
    """The frame with a new explanation; lengths in pixels of the full image."""
    motion = _scaled(best.motion, 1.0 / factor)
    depth, alpha = rendered.depth, rendered.alpha
    assert depth is not None

    def fields(of: FrameMotion) -> DisplacementFields:
        return displacement_fields(of, camera, depth, alpha, margin, factor)

    whole, turned = fields(motion), fields(replace(motion, pose=np.zeros(TWIST), blur=motion.skew))
    return replace(
        frame,
        motion=motion,
        model=best.model,
        misfit=best.misfit,
        misfit_still=best.misfit_still,
        blur_px=_mean_length(whole.sweep) / factor,
        skew_px=_mean_length(turned.sweep) / factor,
        defocus_px=float(whole.radius.cpu().numpy().mean(dtype=np.float64)) / factor,
        reach_px=reach_of(whole) / factor,
    )


def reach_of(fields: DisplacementFields) -> float:
    """See `FrameFormation.reach_px`."""
    displacements = fields.offset.abs() + 0.5 * fields.sweep.abs() + fields.radius
    return float(np.quantile(displacements.amax(dim=0)[::4, ::4].cpu().numpy(), 0.95))


def _mean_length(field: Tensor) -> float:
    return float(np.hypot(*field.cpu().numpy()).mean(dtype=np.float64))


def _scaled(motion: FrameMotion, factor: float) -> FrameMotion:
    if factor == 1.0:
        return motion
    return replace(motion.with_vector(factor * motion.vector), disc_px=factor * motion.disc_px)


def margin_for(reach: float, camera: Camera) -> int:
    """The margin that shows what moved in from beyond the border."""
    largest = int(MARGIN_SHARE * min(camera.width, camera.height)) // MARGIN_STEP * MARGIN_STEP
    return min(largest, MARGIN_STEP * math.ceil(reach / MARGIN_STEP)) if reach >= 0.5 else 0


def as_row(frame: FrameFormation) -> dict[str, Any]:
    """The frame by the names that ``formation.parquet`` gives to its numbers."""
    motion = frame.motion
    row: dict[str, Any] = {name: getattr(frame, name) for name in ("frame_id", "model", "draws")}
    for name in TWISTS:
        row |= {f"{name}_{axis}": float(v) for axis, v in zip(AXES, getattr(motion, name), strict=True)}
    row |= {name: getattr(motion, name) for name in LENS}
    return row | {name: getattr(frame, name) for name in (*MEASURED, "skew_gain")}


def from_row(row: Mapping[str, Any]) -> FrameFormation:
    """The frame of which `as_row` gave this; without ``draws``, as before the first one."""
    vector = np.array([row[f"{name}_{axis}"] for name in TWISTS for axis in AXES])
    return FrameFormation(
        row["frame_id"],
        FrameMotion(**{name: row[name] for name in LENS}).with_vector(vector),
        row["model"],
        draws=row.get("draws", 0),
        **{name: row[name] for name in (*MEASURED, "skew_gain")},
    )


def packed(frames: Iterable[FrameFormation]) -> NDArray[np.float64]:
    """The frames for a checkpoint, [F, numbers of one]."""
    rows = []
    for frame in frames:
        gain = -1.0 if frame.skew_gain is None else frame.skew_gain
        row = as_row(frame) | {"model": MODELS.index(frame.model), "skew_gain": gain}
        rows.append(list(row.values()))
    return np.array(rows, np.float64).reshape(len(rows), len(as_row(FrameFormation(0))))


def unpacked(numbers: NDArray[np.float64]) -> Iterator[FrameFormation]:
    """The frames of which `packed` gave these numbers."""
    names = tuple(as_row(FrameFormation(0)))
    for row in (dict(zip(names, values, strict=True)) for values in numbers.tolist()):
        gain = None if row["skew_gain"] < 0.0 else row["skew_gain"]
        counts = {name: int(row[name]) for name in ("frame_id", "draws")}
        yield from_row(row | counts | {"model": MODELS[int(row["model"])], "skew_gain": gain})
