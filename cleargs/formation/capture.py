"""The formation of every frame of a capture, found while a scene is trained on them.

A frame's formation is estimated again each time the frame has been drawn so often
(`FormationConfig.every`), in the light of the scene as it is then: blurred frames have taught it some of
their blur, and the sharper it becomes the more of their motion shows.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from statistics import median

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.formation.exposure import AffineOptimiser, Exposure
from cleargs.formation.frame import FrameFormation, fit_motion, packed, unpacked
from cleargs.formation.observed import FormedView, pixel_weights
from cleargs.splat.config import FormationConfig
from cleargs.splat.formation import Renderer
from cleargs.splat.types import group
from cleargs.splat.views import TrainingView

SEARCH_EVERY = 4
"""One in so many fits of a frame begins from scratch."""

ROLLING = 0.015
"""Share of the misfit that a rolling shutter must explain beyond all else, in half of a capture's frames:
docs/formation.md."""
ROLLING_START = 0.1
"""Share of the schedule from which frames are tested for it. A scene learns to look like skewed frames, and
where few frames see a place it hides a skew before `FormationConfig.start`: docs/experiments/formation.md."""
MIN_TESTED_FRAMES, MAX_TESTED_FRAMES = 4, 16
"""Frames that must have been tested before a rolling shutter is believed, and most that are tested; between
these, half of the capture's frames are."""


def rolls(frames: Iterable[FrameFormation]) -> bool:
    """Whether the capture's shutter rolls, by what its frames say together.

    A camera's shutter rolls in every frame or in none, but a single skew can absorb what the geometry or
    the pose of one frame has wrong.
    """
    gains = [frame.skew_gain for frame in frames if frame.skew_gain is not None]
    return len(gains) >= MIN_TESTED_FRAMES and median(gains) > ROLLING


class CaptureFormation:
    """Fulfils `cleargs.splat.formation.Formation` for a capture."""

    def __init__(
        self,
        views: Sequence[TrainingView],
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
        # Counted anew: every training begins with a search, which pays (docs/experiments/formation.md).
        self._frames = {
            frame_id: replace(known.get(frame_id, FrameFormation(frame_id)), draws=0) for frame_id in real
        }
        self._tested = {real[k] for k in _tested_frames(len(real))}
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
        """The weight of a raw frame in the training: RVA's, or what it has earned where that is more.

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
        view: TrainingView,
        factor: float,
        progress: float,
        target: Tensor,
        mask: Tensor | None,
        render: Renderer,
    ) -> FormedView | None:
        """See `cleargs.splat.formation.Formation`."""
        frame_id, camera = view.frame_id, view.camera.scaled(factor)
        affines = self._affines
        affine = None if affines is None else affines.affine(frame_id)

        def explained() -> FrameFormation:
            """How the frame was taken, in the light of the scene as it is."""
            frame = self._frames[frame_id]
            return fit_motion(
                frame,
                self._config,
                camera,
                affine,
                target,
                mask,
                render,
                factor=factor,
                warm=(frame.draws // self._config.every) % SEARCH_EVERY != 0,
                rolling=self._rolls(),
                test_rolling=frame_id in self._tested,
            )

        begun = progress >= self._config.start
        searched = self._config.enabled and view.kind == "real"
        if searched and not begun:
            untested = frame_id in self._tested and self._frames[frame_id].skew_gain is None
            if progress >= ROLLING_START and untested and not self._rolls():
                gain = explained().skew_gain
                self._frames[frame_id] = replace(self._frames[frame_id], skew_gain=gain)
            searched = self._rolls()
        if searched and self._frames[frame_id].draws % self._config.every == 0:
            self._frames[frame_id] = explained()
        weight = view.weight
        motion = None
        if searched:
            frame = self._frames[frame_id]
            self._frames[frame_id] = replace(frame, draws=frame.draws + 1)
            weight = self.weight(frame_id)
            if frame.model != "none":
                motion = frame
        robust_mask = None
        if begun and self._config.unexplained > 0.0:
            tolerance = self._config.unexplained
            robust_mask = partial(pixel_weights, target=target, mask=mask, tolerance=tolerance)
        if motion is None and affine is None and robust_mask is None:
            return None
        return FormedView(
            camera,
            weight,
            frame_id=frame_id,
            affine=affine,
            affines=affines,
            formation=motion,
            factor=factor,
            robust_mask=robust_mask,
        )

    def digest(self) -> str:
        """A digest of the settings and of what it starts from."""
        digest = hashlib.sha256(self._config.model_dump_json().encode())
        for name, tensor in sorted(self.state().items()):
            digest.update(name.encode())
            digest.update(tensor.numpy().tobytes())
        return digest.hexdigest()

    def state(self) -> dict[str, Tensor]:
        """The numbers of all frames, and the affines with their moments."""
        state = {"frames": torch.from_numpy(packed(self._frames.values()))}
        if self._affines is not None:
            for name, array in self._affines.arrays().items():
                state[f"exposure.{name}"] = torch.from_numpy(array)
        return state

    def restore(self, state: dict[str, Tensor]) -> None:
        """Resume from what `state` gave."""
        self._frames = {frame.frame_id: frame for frame in unpacked(state["frames"].numpy())}
        if self._affines is not None:
            affines = group(state, "exposure.")
            self._affines.restore({name: tensor.numpy() for name, tensor in affines.items()})

    def fault(self) -> str | None:
        """What in it is not finite; None where all is."""
        if self._affines is not None and not np.isfinite(self._affines.affines).all():
            return "exposure is not finite"
        return None

    def _rolls(self) -> bool:
        return rolls(self._frames.values())


def _tested_frames(count: int) -> list[int]:
    """Which of ``count`` frames in a row are tested for a rolling shutter: evenly spread."""
    tested = min(count, max(MIN_TESTED_FRAMES, min(MAX_TESTED_FRAMES, count // 2)))
    return [(2 * k + 1) * count // (2 * tested) for k in range(tested)]


def _affines(exposure: Exposure, views: Sequence[TrainingView], rate: float) -> AffineOptimiser:
    """Affines for every frame given or seen; the median counts the weights of the real views."""
    frame_ids = np.union1d(exposure.frame_ids, [view.frame_id for view in views]).astype(np.int32)
    weights: NDArray[np.float64] = np.zeros(len(frame_ids))
    for view in views:
        if view.kind == "real":
            weights[np.searchsorted(frame_ids, view.frame_id)] = view.weight
    known = Exposure(frame_ids, np.stack([exposure.of(int(frame_id)) for frame_id in frame_ids]))
    return AffineOptimiser(known, weights, rate)
