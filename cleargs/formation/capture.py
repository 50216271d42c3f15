"""The formation of every frame of a capture, found while a scene is trained on them.

A frame is asked again each time it has been drawn so often (`FormationConfig.every`), in the light of the
scene as it is then: blurred frames have taught it some of their blur, and the sharper it becomes the more of
their motion shows.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.formation.colour import AffineOptimiser, Exposure, affine_backward, apply_affine
from cleargs.formation.motion import MODELS, TWIST, Floats, FrameMotion, Model
from cleargs.formation.search import (
    Explanation,
    Sight,
    explained_share,
    luminance,
    preferred,
    refine,
    search,
)
from cleargs.formation.warp import (
    Fields,
    Warp,
    fields_of,
    linear_curve,
    srgb_curve,
    through_curve,
    times_slope,
)
from cleargs.splat.camera import Camera
from cleargs.splat.config import FormationConfig
from cleargs.splat.engine import Render
from cleargs.splat.formation import Renderer
from cleargs.splat.kernels.cpu.pixel import CHANNELS
from cleargs.splat.views import View

MARGIN_STEP = 4
"""Margins are multiples of it, px."""
MARGIN_SHARE = 0.25
"""Most of a margin, as a share of the shorter side."""
SEARCH_EVERY = 4
"""Of the fits of a frame one in so many begins from scratch."""

_NUMBERS = 3 + 3 * TWIST + 3 + 2 + 4
"""Of a frame in a checkpoint."""


@dataclass(frozen=True)
class FrameFormation:
    """What is known of how one frame was taken."""

    frame_id: int
    motion: FrameMotion = field(default_factory=FrameMotion)
    model: Model = "none"
    misfit: float = 0.0
    """Mean difference of high-passed linear luminance that the model leaves, see `search.Explanation`."""
    misfit_still: float = 0.0
    blur_px: float = 0.0
    """Mean length of the pixels' ways while they were exposed."""
    skew_px: float = 0.0
    """Mean length of their ways from the first to the last row's exposure."""
    defocus_px: float = 0.0
    """Mean radius of the discs."""
    reach_px: float = 0.0
    """Farthest that a pixel looks from its place (95 % of them look less far)."""
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


class CaptureFormation:
    """Fulfils `cleargs.splat.formation.Formation` for a capture."""

    def __init__(
        self,
        views: Sequence[View],
        config: FormationConfig,
        *,
        exposure: Exposure | None = None,
        lr_exposure: float = 0.0,
        known: Mapping[int, FrameFormation] | None = None,
    ) -> None:
        """``exposure`` None: no colour affines. ``known``: what an earlier training found."""
        weighted = [view for view in views if view.weight > 0.0]
        self._config = config
        self._affines = None if exposure is None else _affines(exposure, weighted, lr_exposure)
        real = sorted(view.frame_id for view in weighted if view.kind == "real")
        known = known or {}
        self._frames = {
            frame_id: replace(known.get(frame_id, FrameFormation(frame_id)), draws=0) for frame_id in real
        }
        self._weights = {view.frame_id: view.weight for view in weighted if view.kind == "real"}

    @property
    def exposure(self) -> Exposure | None:
        """The affines learned so far; None where exposure is off."""
        return None if self._affines is None else self._affines.exposure

    @property
    def frames(self) -> dict[int, FrameFormation]:
        """What is known of the raw frames, by frame_id."""
        return dict(self._frames)

    def weight(self, frame_id: int) -> float:
        """With which a raw frame teaches: RVA's weight, or what it has earned where that is more.

            w = max(w_RVA, trust),  trust = min(1, rho / misfit)^p

        rho is the median misfit of the frames, each counted with its w_RVA, and p is `FormationConfig.trust`:
        a frame that its model explains as well as reliable frames are explained teaches like one of them.
        """
        prior, frame = self._weights[frame_id], self._frames[frame_id]
        if frame.model == "none" or frame.misfit <= 0.0:
            return prior
        trust: float = min(1.0, self._reference() / frame.misfit) ** self._config.trust
        return max(prior, trust)

    def _reference(self) -> float:
        """The weighted median of the misfits."""
        known = sorted((f.misfit, self._weights[f.frame_id]) for f in self._frames.values() if f.misfit > 0.0)
        half, passed = 0.5 * math.fsum(weight for _, weight in known), 0.0
        for misfit, weight in known:
            passed += weight
            if passed >= half:
                return misfit
        return 0.0

    def form(
        self,
        view: View,
        factor: float,
        progress: float,
        target: Tensor,
        mask: Tensor | None,
        render: Renderer,
    ) -> FormedView | None:
        """See `cleargs.splat.formation.Formation`."""
        camera = view.camera.scaled(factor)
        affines = self._affines
        affine = None if affines is None else affines.affine(view.frame_id)
        searched = view.kind == "real" and self._config.enabled and progress >= self._config.start
        if searched and self._due(view.frame_id):
            self._fit(view.frame_id, factor, camera, affine, target, mask, render)
        weight = view.weight
        motion = None
        if searched:
            frame = self._frames[view.frame_id]
            self._frames[view.frame_id] = replace(frame, draws=frame.draws + 1)
            weight = self.weight(view.frame_id)
            if frame.model != "none":
                motion = frame
        if motion is None and affine is None:
            return None
        return FormedView(
            camera,
            weight,
            frame_id=view.frame_id,
            affine=affine,
            affines=affines,
            formation=motion,
            factor=factor,
        )

    def digest(self) -> str:
        """Of the settings and of what it starts from."""
        digest = hashlib.sha256(self._config.model_dump_json().encode())
        for name, tensor in sorted(self.state().items()):
            digest.update(name.encode())
            digest.update(tensor.numpy().tobytes())
        return digest.hexdigest()

    def state(self) -> dict[str, Tensor]:
        """The numbers of all frames, and the affines with their moments."""
        rows = [_packed(frame) for frame in self._frames.values()]
        state = {"frames": torch.tensor(np.array(rows, np.float64).reshape(len(rows), _NUMBERS))}
        if self._affines is not None:
            for name, array in self._affines.arrays().items():
                state[f"exposure.{name}"] = torch.from_numpy(array)
        return state

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on from what `state` gave."""
        rows = state["frames"].numpy()
        self._frames = {frame.frame_id: frame for frame in map(_unpacked, rows)}
        if self._affines is not None:
            prefix = "exposure."
            self._affines.restore(
                {name.removeprefix(prefix): t.numpy() for name, t in state.items() if name.startswith(prefix)}
            )

    def fault(self) -> str | None:
        """What of it is not finite."""
        if self._affines is not None and not np.isfinite(self._affines.affines).all():
            return "exposure is not finite"
        return None

    def _due(self, frame_id: int) -> bool:
        return self._frames[frame_id].draws % self._config.every == 0

    def _fit(
        self,
        frame_id: int,
        factor: float,
        camera: Camera,
        affine: Tensor | None,
        target: Tensor,
        mask: Tensor | None,
        render: Renderer,
    ) -> None:
        """Ask how the frame was taken, in the light of the scene as it is."""
        frame = self._frames[frame_id]
        again = (frame.draws // self._config.every) % SEARCH_EVERY != 0
        self._frames[frame_id] = explain(
            frame, self._config, camera, affine, target, mask, render, factor=factor, warm=again
        )


def explain(
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
) -> FrameFormation:
    """How a raw frame was taken, in the light of the scene that ``render`` shows.

    Args:
        frame: what is known already; its model stays in the race.
        camera: of the frame, reduced by ``factor``.
        affine: the frame's colour, [3, 4].
        target, mask: the frame, [H, W, 3] sRGB and [H, W].
        warm: refine what is known instead of searching among all models.
    """
    margin = _margin(frame.reach_px * factor, camera) if warm else _search_margin(camera)
    rendered = render(widened(camera, margin))
    sight = sight_of(rendered, affine, target, mask, camera, margin)
    known = _scaled(frame.motion, factor)
    if warm:
        found = refine(sight, frame.model, known, pose=config.pose)
        best = found[-1]
    else:
        found = search(sight, pose=config.pose)
        if frame.model != "none":
            found += refine(sight, frame.model, known, pose=config.pose)[1:]
        best = preferred(found)
    # Hysteresis: what was taken before may stay at half the gain that lets a model in.
    if best.explained < config.accept * (0.5 if frame.model == best.model else 1.0):
        best = found[0]
    return _described(frame, best, factor, camera, rendered, margin)


@dataclass(eq=False)
class FormedView:
    """Fulfils `cleargs.splat.formation.Formed`: colour, then motion and defocus in linear light."""

    camera: Camera
    weight: float
    frame_id: int = -1
    affine: Tensor | None = None
    affines: AffineOptimiser | None = None
    formation: FrameFormation | None = None
    factor: float = 1.0

    def __post_init__(self) -> None:
        self._photo = self.camera
        self._margin = 0
        if self.formation is not None:
            self._margin = _margin(self.formation.reach_px * self.factor, self._photo)
            self.camera = widened(self._photo, self._margin)
        self.needs_depth = self.formation is not None

    def forward(self, render: Render) -> Tensor:
        image = render.image
        if self.affine is not None:
            self._rendered = render.image
            image = apply_affine(image, self.affine)
        if self.formation is None:
            return image
        self._warp = self.warp(render)
        linear, self._to_linear = through_curve(image.cpu().numpy(), linear_curve(), CHANNELS)
        photograph, self._to_srgb = through_curve(self._warp.forward(linear), srgb_curve())
        return torch.from_numpy(photograph).to(image.device)

    def warp(self, render: Render) -> Warp:
        """B of the frame, from a render at ``camera`` with depth."""
        assert self.formation is not None and render.depth is not None
        fields = fields_of(
            self.formation.motion,
            self._photo,
            render.depth.cpu().numpy(),
            render.alpha.cpu().numpy(),
            self._margin,
            self.factor,
        )
        return Warp.of(fields, self._margin)

    def backward(self, gradient: Tensor) -> Tensor:
        if self.formation is not None:
            light = times_slope(gradient.cpu().numpy(), self._to_srgb, CHANNELS)
            light = times_slope(self._warp.transpose(light), self._to_linear)
            gradient = torch.from_numpy(light).to(gradient.device)
        if self.affine is not None:
            gradient, self._affine_gradient = affine_backward(self._rendered, self.affine, gradient)
        return gradient

    def learn(self) -> None:
        if self.affines is not None:
            self.affines.step(self.frame_id, self._affine_gradient.cpu().numpy())


def widened(camera: Camera, margin: int) -> Camera:
    """The camera with ``margin`` more pixels on every side."""
    if margin == 0:
        return camera
    return replace(
        camera,
        width=camera.width + 2 * margin,
        height=camera.height + 2 * margin,
        cx=camera.cx + margin,
        cy=camera.cy + margin,
    )


def sight_of(
    rendered: Render, affine: Tensor | None, target: Tensor, mask: Tensor | None, camera: Camera, margin: int
) -> Sight:
    """What `search` compares: masked pixels of the frame show the render."""
    assert rendered.depth is not None
    image = rendered.image if affine is None else apply_affine(rendered.image, affine)
    shown, seen = image.clamp(0.0, 1.0).cpu().numpy(), target.cpu().numpy()
    counts = np.ones(seen.shape[:2], np.bool_) if mask is None else mask.cpu().numpy()
    inner = shown[margin : margin + camera.height, margin : margin + camera.width]
    return Sight(
        luminance(shown),
        rendered.depth.cpu().numpy(),
        rendered.alpha.cpu().numpy(),
        luminance(np.where(counts[..., None], seen, inner)),
        counts.astype(np.float32),
        camera,
        margin,
    )


def _described(
    frame: FrameFormation, best: Explanation, factor: float, camera: Camera, rendered: Render, margin: int
) -> FrameFormation:
    """The frame with a new explanation; lengths in pixels of the full image."""
    motion = _scaled(best.motion, 1.0 / factor)
    assert rendered.depth is not None
    depth, alpha = rendered.depth.cpu().numpy(), rendered.alpha.cpu().numpy()

    def fields(of: FrameMotion) -> Fields:
        return fields_of(of, camera, depth, alpha, margin, factor)

    whole, turned = fields(motion), fields(replace(motion, pose=np.zeros(TWIST), blur=motion.skew))
    ways = np.abs(whole.offset) + 0.5 * np.abs(whole.sweep) + whole.radius
    return replace(
        frame,
        motion=motion,
        model=best.model,
        misfit=best.misfit,
        misfit_still=best.misfit_still,
        blur_px=_mean_length(whole.sweep) / factor,
        skew_px=_mean_length(turned.sweep) / factor,
        defocus_px=float(whole.radius.mean(dtype=np.float64)) / factor,
        reach_px=float(np.quantile(ways.max(axis=0)[::4, ::4], 0.95)) / factor,
    )


def _mean_length(field: Floats) -> float:
    return float(np.hypot(*field).mean(dtype=np.float64))


def _scaled(motion: FrameMotion, factor: float) -> FrameMotion:
    if factor == 1.0:
        return motion
    return replace(motion.with_vector(factor * motion.vector), disc_px=factor * motion.disc_px)


def _margin(reach: float, camera: Camera) -> int:
    """That shows what moved in from beyond the border."""
    largest = int(MARGIN_SHARE * min(camera.width, camera.height)) // MARGIN_STEP * MARGIN_STEP
    return min(largest, MARGIN_STEP * math.ceil(reach / MARGIN_STEP)) if reach >= 0.5 else 0


def _search_margin(camera: Camera) -> int:
    """For a search, whose motions are not known yet."""
    return _margin(0.05 * max(camera.width, camera.height), camera)


def _affines(exposure: Exposure, views: Sequence[View], rate: float) -> AffineOptimiser:
    """Affines for every frame given or seen; the median counts the weights of the real views."""
    frame_ids = np.union1d(exposure.frame_ids, [view.frame_id for view in views]).astype(np.int32)
    weights: NDArray[np.float64] = np.zeros(len(frame_ids))
    for view in views:
        if view.kind == "real":
            weights[np.searchsorted(frame_ids, view.frame_id)] = view.weight
    known = Exposure(frame_ids, np.stack([exposure.of(int(frame_id)) for frame_id in frame_ids]))
    return AffineOptimiser(known, weights, rate)


def _packed(frame: FrameFormation) -> NDArray[np.float64]:
    motion = frame.motion
    return np.concatenate(
        [
            [frame.frame_id, MODELS.index(frame.model), frame.draws],
            motion.vector,
            [motion.disc_px, motion.focus, motion.median_depth],
            [frame.misfit, frame.misfit_still],
            [frame.blur_px, frame.skew_px, frame.defocus_px, frame.reach_px],
        ]
    )


def _unpacked(row: NDArray[np.float64]) -> FrameFormation:
    frame_id, model, draws = (int(value) for value in row[:3])
    vector, rest = row[3 : 3 + 3 * TWIST], [float(value) for value in row[3 + 3 * TWIST :]]
    disc_px, focus, median_depth, misfit, misfit_still, blur_px, skew_px, defocus_px, reach_px = rest
    return FrameFormation(
        frame_id,
        FrameMotion(disc_px=disc_px, focus=focus, median_depth=median_depth).with_vector(vector),
        MODELS[model],
        misfit,
        misfit_still,
        blur_px,
        skew_px,
        defocus_px,
        reach_px,
        draws,
    )
