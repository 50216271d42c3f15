"""The formation of every frame of a capture, estimated while a scene is trained on the frames.

A frame's formation is estimated again after every `FormationConfig.every` steps on the frame. Each estimate
refines the motion with the current scene. All models are searched from scratch for an `estimate.Reason`:

| estimate | path of a higher order | search |
|---|---|---|
| first | tried | yes, but not if ``first_search`` is off or other frames show a sharp capture |
| 4th, 8th, 16th, ... after it | tried | if the path is curved or the shutter rolls |
| any | - | if `pretest` (a few milliseconds) finds blur that the model does not explain |

A frame that follows its measured motion is estimated half as often (`MEASURED_EVERY`).

`pretest` cannot see a skew: while a rolling shutter is possible, frames are searched for it. Later trainings
continue with formations and numbers of estimates. They keep the formation of a frame after
`ESTIMATES_TO_KEEP` estimates.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from statistics import median
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.formation.estimate import Shot, Terms, fit_motion
from cleargs.formation.exposure import AffineOptimiser, Exposure
from cleargs.formation.formed import FormedView
from cleargs.formation.frame import FrameFormation, filmed_as, packed, unpacked
from cleargs.formation.measured import MeasuredPath
from cleargs.formation.movement import Movement
from cleargs.formation.shutter import (
    MIN_TIMED_FRAMES,
    ROLLING,
    CameraSpeeds,
    frames_to_test,
    rolls,
    with_skew,
)
from cleargs.splat.config import FormationConfig
from cleargs.splat.formation import Renderer
from cleargs.splat.types import Render, group
from cleargs.splat.views import TrainingView
from cleargs.types import MaskBool

ROLLING_START = 0.1
"""Fraction of the schedule from which frames are tested for a rolling shutter. The scene gradually learns the
skew of the frames. At places that few frames see, it hides their skew before `FormationConfig.start`
(docs/experiments/formation.md)."""
LOW_WEIGHT = 0.5
"""RVA weight below which less blur is enough for a search."""
RETRY_AFTER = 4
"""Number of estimates from the first one to the next try of a higher order and, if the shutter rolls, to the
next search. It doubles from one try to the next, because the scene changes less and less."""
ESTIMATES_TO_KEEP = 7
"""Estimates of a frame's formation after which later trainings keep it. Scenes lost nothing after 7 and 15,
and up to 0.2 dB after 3 (docs/experiments/formation.md)."""
MEASURED_EVERY = 2
"""Factor on ``every`` for frames that follow their measured motion (docs/experiments/formation.md)."""
CLEAR_BLUR, EXPOSED_FRAMES, MIN_EXPOSED_FRAMES = 3.0, 9, 3
"""Blur, px, that shows the exposure time of its frame; largest and smallest number of frames around a frame
from which its exposure time is known."""
MEASURED_SHARE = 0.5
"""Least share of the frames with a measured motion, at which ingest decides if the shutter rolls."""
SHARP_SHARE, MIN_SEARCHED_FRAMES = 1 / 8, 12
"""A capture is sharp if at most this share of the frames with an estimate need a model, and at least this
many have one. In a sharp capture a frame is first searched only if the test finds blur."""


def median_residual(frames: Iterable[FrameFormation], weights: Mapping[int, float]) -> float:
    """Return the median residual of the frames, weighted by ``weights``; 0 if none is known."""
    known = sorted(
        (frame.residual, weights.get(frame.frame_id, 0.0)) for frame in frames if frame.residual > 0.0
    )
    half, passed = 0.5 * math.fsum(weight for _, weight in known), 0.0
    for residual, weight in known:
        passed += weight
        if passed >= half:
            return residual
    return 0.0


class CaptureFormation:
    """Image formation of a capture, an implementation of `cleargs.splat.formation.Formation`."""

    def __init__(
        self,
        views: Sequence[TrainingView],
        config: FormationConfig,
        *,
        exposure: Exposure | None = None,  # initial colour affines; None: no exposure compensation
        lr_exposure: float = 0.0,  # learning rate of the affines
        known: Mapping[int, FrameFormation] | None = None,  # from an earlier training, by frame_id
        moving: Mapping[int, MaskBool] | None = None,  # cells that move, from an earlier training
        tolerance: float = 0.0,  # difference of mean sRGB colours above which a cell can move; 0: no checks
        measured: Mapping[int, MeasuredPath] | None = None,  # motions of ingest, by frame_id
    ) -> None:
        weighted = [view for view in views if view.weight > 0.0]
        self._config = config
        self._affines = None if exposure is None else _affines(exposure, weighted, lr_exposure)
        filmed = sorted((v for v in weighted if v.kind == "real"), key=lambda view: view.frame_id)
        real = [view.frame_id for view in filmed]
        known, self._measured = known or {}, measured or {}
        self._frames = {view.frame_id: known.get(view.frame_id) or self._unseen(view) for view in filmed}
        judged = sum(frame_id in self._measured for frame_id in real)
        self._readout_found = any(path.rolls for path in self._measured.values())
        self._shutter_measured = judged >= max(MIN_TIMED_FRAMES, MEASURED_SHARE * len(real))
        last = ESTIMATES_TO_KEEP - 1
        self._kept = {k for k, frame in self._frames.items() if frame.steps > last * self._every(k)}
        self._tested = {real[k] for k in frames_to_test(len(real))}
        self._weights = {view.frame_id: view.weight for view in filmed}
        self._speeds = CameraSpeeds.of(filmed)
        estimated = {view.frame_id for view in filmed if view.estimated}
        self._posed = {"auto": estimated, "on": set(real), "off": set[int]()}[config.pose]
        cameras = {view.frame_id: view.camera for view in weighted}
        likely = {view.frame_id: view.movers for view in weighted if view.movers}
        self._movement = Movement(cameras, tolerance, moving, likely)
        self._visits = dict.fromkeys(cameras, 0)

    @property
    def exposure(self) -> Exposure | None:
        """The affines learned so far; None if exposure compensation is off."""
        return None if self._affines is None else self._affines.exposure

    @property
    def frames(self) -> dict[int, FrameFormation]:
        """Formations of the frames, by frame_id."""
        return dict(self._frames)

    @property
    def moving(self) -> dict[int, MaskBool]:
        """Cells that move [rows, columns], by frame_id, for frames in which something moves."""
        return self._movement.masks()

    def weight(self, frame_id: int) -> float:
        """Return the weight of a frame image in the training: RVA's weight, or its trust if that is larger.

            w = max(w_RVA, trust),  trust = min(1, rho / residual)^p

        rho is the median residual of the frames, weighted by w_RVA, and p is `FormationConfig.trust`. A frame
        that is explained as well as reliable frames counts like one of them, also if it needs no model: RVA
        can mistake a sharp frame image of soft things, such as fur, for a blurred one.
        """
        prior, frame = self._weights[frame_id], self._frames[frame_id]
        if frame.residual <= 0.0:  # not compared with the scene so far
            return prior
        reference = median_residual(self._frames.values(), self._weights)
        trust: float = min(1.0, reference / frame.residual) ** self._config.trust
        return max(prior, trust)

    def form(
        self,
        view: TrainingView,
        factor: float,
        progress: float,
        observed: Tensor,
        mask: Tensor | None,
        render: Renderer,
    ) -> FormedView | None:
        """See `cleargs.splat.formation.Formation`."""
        frame_id, camera = view.frame_id, view.camera.scaled(factor)
        affines = self._affines
        affine = None if affines is None else affines.affine(frame_id)
        own, mask = mask, self._movement.static_mask(frame_id, mask, observed)
        weight, motion = view.weight, None
        if self._config.enabled and view.kind == "real":
            shot = Shot(camera, affine, observed, mask, render, factor)
            if self._estimated(frame_id, progress, shot):
                frame = self._frames[frame_id]
                self._frames[frame_id] = replace(frame, steps=frame.steps + 1)
                weight = self.weight(frame_id)
            frame = self._frames[frame_id]
            motion = None if frame.model == "none" else frame

        def check(image: Tensor, rendered: Render, margin: int) -> Tensor | None:
            """Find what moves in the frame, and return the pixels that count."""
            self._movement.check(frame_id, image, rendered, margin, observed, own)
            return self._movement.static_mask(frame_id, own, observed)

        checks = False
        if view.kind == "real" or frame_id not in self._frames:
            checks = self._movement.due(self._visits[frame_id], progress)
            self._visits[frame_id] += 1
        if motion is None and affine is None and mask is own and weight == view.weight and not checks:
            return None
        return FormedView(
            camera,
            weight,
            frame_id=frame_id,
            affine=affine,
            affines=affines,
            formation=motion,
            factor=factor,
            mask=mask,
            check=check if checks else None,
        )

    def _estimated(self, frame_id: int, progress: float, shot: Shot) -> bool:
        """Estimate the formation of a frame if it is due. Return False before the estimates begin."""
        if progress < self._config.start and not self._rolls():
            if progress >= ROLLING_START and self._asks(frame_id):
                gain = self._estimate(frame_id, shot).skew_gain
                self._frames[frame_id] = replace(self._frames[frame_id], skew_gain=gain)
            if not self._rolls():
                return False
        if self._due(frame_id):
            self._frames[frame_id] = self._estimate(frame_id, shot)
            if self._all_estimated(frame_id):
                self._add_missing_skew()
        return True

    def _estimate(self, frame_id: int, shot: Shot) -> FrameFormation:
        """Return the formation of a frame, estimated with the current scene."""
        frame = self._frames[frame_id]
        tested: Literal["tested", "global"] = "tested" if self._asks(frame_id) else "global"
        terms = Terms(
            pose=frame_id in self._posed,
            low_weight=self._weights[frame_id] < LOW_WEIGHT,
            shutter="rolling" if self._rolls(frame_id) else tested,
            curve=_tries_higher_order(frame.steps // self._every(frame_id)),
            only_if_blur_found=not self._config.first_search or self._sharp(),
            exposure_s=self._exposure(frame_id),
            measured=self._measured.get(frame_id),
        )
        return fit_motion(frame, self._config, shot, terms)

    def _exposure(self, frame_id: int) -> float:
        """Return the median exposure time, s, of the nearest frames whose blur is a measured motion; else 0.

        Automatic exposure changes slowly, and every frame is exposed, also where little blur shows it.
        """
        blurred = [
            (abs(k - frame_id), frame.motion.exposure_s)
            for k, frame in self._frames.items()
            if k != frame_id and frame.motion.exposure_s > 0.0 and frame.blur_px >= CLEAR_BLUR
        ]
        nearest = [seconds for _, seconds in sorted(blurred)[:EXPOSED_FRAMES]]
        return median(nearest) if len(nearest) >= MIN_EXPOSED_FRAMES else 0.0

    def digest(self) -> str:
        """Return a digest of the settings and of the formations at the start."""
        digest = hashlib.sha256(self._config.model_dump_json().encode())
        for name, tensor in sorted(self.state().items()):
            digest.update(name.encode())
            digest.update(tensor.numpy().tobytes())
        return digest.hexdigest()

    def state(self) -> dict[str, Tensor]:
        """Return the numbers of all frames, and the affines with their moments."""
        state = {"frames": torch.from_numpy(packed(self._frames.values())), **self._movement.state()}
        state["movement.visits"] = torch.tensor(list(self._visits.values()))
        if self._affines is not None:
            for name, array in self._affines.arrays().items():
                state[f"exposure.{name}"] = torch.from_numpy(array)
        return state

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continue from the result of `state`."""
        self._movement.restore(state)
        self._visits = dict(zip(self._visits, state["movement.visits"].tolist(), strict=True))
        self._frames = {frame.frame_id: frame for frame in unpacked(state["frames"].numpy())}
        if self._affines is not None:
            affines = group(state, "exposure.")
            self._affines.restore({name: tensor.numpy() for name, tensor in affines.items()})

    def fault(self) -> str | None:
        """Return a description of values that are not finite, or None."""
        if self._affines is not None and not np.isfinite(self._affines.affines).all():
            return "exposure is not finite"
        return None

    def _unseen(self, view: TrainingView) -> FrameFormation:
        """Return the formation of a frame before the first estimate: its measured skew."""
        path = self._measured.get(view.frame_id)
        if path is None or not path.rolls:
            return FrameFormation(view.frame_id)
        return filmed_as(path.read(view.camera), view.frame_id)

    def _rolls(self, frame_id: int | None = None) -> bool:
        """Return True if frames, or this one, may have a skew that must be searched.

        If ingest found a readout, these are the frames without a measured motion.
        """
        if self._shutter_measured:
            return frame_id is not None and frame_id not in self._measured and self._readout_found
        return rolls(self._frames.values())

    def _asks(self, frame_id: int) -> bool:
        """Return True if a frame must still be tested for a rolling shutter.

        Once more than half of the frames to test show no skew, the others cannot change the median.
        """
        if self._shutter_measured or frame_id not in self._tested:
            return False
        if self._frames[frame_id].skew_gain is not None:
            return False
        gains = [self._frames[k].skew_gain for k in self._tested]
        return 2 * sum(gain is not None and gain <= ROLLING for gain in gains) <= len(gains)

    def _due(self, frame_id: int) -> bool:
        """Return True if the formation of a frame is estimated before the next step on it."""
        steps = self._frames[frame_id].steps
        return steps == 0 or (steps % self._every(frame_id) == 0 and frame_id not in self._kept)

    def _every(self, frame_id: int) -> int:
        """Return the number of steps on a frame between two estimates."""
        follows = frame_id in self._measured and not self._frames[frame_id].searched
        return self._config.every * (MEASURED_EVERY if follows else 1)

    def _all_estimated(self, frame_id: int) -> bool:
        """Return True if an estimate of this frame completes a round of estimates of all frames."""
        before = self._frames[frame_id].steps
        return all(frame.steps > before for k, frame in self._frames.items() if k != frame_id)

    def _add_missing_skew(self) -> None:
        """Add the skew that all frames lack in common (`shutter`). The scene then adapts to it."""
        if self._speeds is None or not self._rolls():
            return
        missing = self._speeds.missing_skew(self._frames)
        if missing is not None:
            self._frames = {k: with_skew(frame, missing) for k, frame in self._frames.items()}

    def _sharp(self) -> bool:
        """Return True if few of the frames with an estimate needed a model."""
        models = [frame.model for frame in self._frames.values() if frame.steps > 0]
        modelled = len(models) - models.count("none")
        return len(models) >= MIN_SEARCHED_FRAMES and modelled <= SHARP_SHARE * len(models)


def _tries_higher_order(estimates: int) -> bool:
    """Return True for 0 and for `RETRY_AFTER` times a power of two: 0, 4, 8, 16, 32, ..."""
    rounds, rest = divmod(estimates, RETRY_AFTER)
    return rest == 0 and rounds & (rounds - 1) == 0


def _affines(exposure: Exposure, views: Sequence[TrainingView], rate: float) -> AffineOptimiser:
    """Return the optimiser of the affines of all frames. Only real views have a weight in its median."""
    frame_ids = np.union1d(exposure.frame_ids, [view.frame_id for view in views]).astype(np.int32)
    weights: NDArray[np.float64] = np.zeros(len(frame_ids))
    for view in views:
        if view.kind == "real":
            weights[np.searchsorted(frame_ids, view.frame_id)] = view.weight
    known = Exposure(frame_ids, np.stack([exposure.of(int(frame_id)) for frame_id in frame_ids]))
    return AffineOptimiser(known, weights, rate)
