"""A trained scene that is rendered as the cameras of its frames saw it, and frames without their motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from cleargs.formation.deblur import deblur
from cleargs.formation.estimate import Shot, Terms, fit_motion
from cleargs.formation.formed import FormedView, render_formed
from cleargs.formation.frame import FrameFormation
from cleargs.formation.measured import MeasuredPath
from cleargs.formation.movement import static_pixels
from cleargs.formation.shutter import rolls
from cleargs.media.image import to_float32
from cleargs.scene.folder import SceneFolder
from cleargs.scene.measure import MAX_EVALUATED, evaluate_views, pooled_unseen
from cleargs.sequences import spread
from cleargs.splat.backend import backend_for, rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.config import FormationConfig
from cleargs.splat.types import Render
from cleargs.splat.views import TrainingView
from cleargs.types import ImageF32, MaskBool


@dataclass(frozen=True, eq=False)
class Deblurred:
    """A frame image without its motion or defocus."""

    image: ImageF32
    """[H, W, 3] sRGB in [0, 1], at the frame's pose."""
    formation: FrameFormation
    """The formation that was undone."""


@dataclass(frozen=True, eq=False)
class Explained:
    """The training's explanation of a frame: the render after image formation."""

    image: ImageF32
    """The render as the frame's camera saw it, [H, W, 3] sRGB in [0, 1]."""
    formation: FrameFormation
    weight: float
    """The frame's weight at the end of the training: RVA's, or a higher one by its residual."""


def observed_image(view: TrainingView) -> tuple[ImageF32, MaskBool | None]:
    """Return the frame image O_t [H, W, 3], float32 sRGB in [0, 1], and its mask [H, W] (None: all count)."""
    pixels, mask = view.load()
    return to_float32(pixels), mask


class SceneViewer:
    """A scene on disk, ready to be rendered. StoreError is raised if a file is missing or damaged."""

    def __init__(
        self, folder: Path, device: str = "cpu", measured: Mapping[int, MeasuredPath] | None = None
    ) -> None:
        """``measured`` are the motions of ingest, by frame_id, for trainings and for new estimates."""
        self.files, self.motions, self.device = SceneFolder(folder), measured or {}, device
        self.scene = self.files.scene().to(device)
        self.written_exposure = self.files.exposure()
        self.exposure = self.written_exposure if self.written_exposure.enabled else None
        """The colour affines of the frames; None if exposure compensation is off."""
        self.formations, self._weights = self.files.formations()
        self.moving = self.files.moving()
        """frame_id -> mask of the cells of the frame in which something moves."""
        self._engine = rasteriser_for(device)

    def render(self, view: TrainingView) -> ImageF32:
        """Return R_t: the scene at a view, through the frame's exposure, [H, W, 3] sRGB in [0, 1]."""
        image: ImageF32 = render_formed(self.scene, view, self.exposure, engine=self._engine).cpu().numpy()
        return image

    def formed(self, view: TrainingView) -> Tensor:
        """Return the scene as the camera of a frame saw it, [H, W, 3] sRGB in [0, 1]."""
        formation = self.formations.get(view.frame_id)
        return render_formed(self.scene, view, self.exposure, formation, engine=self._engine).cpu()

    def psnr_unseen(self, views: Sequence[TrainingView]) -> float | None:
        """Return the PSNR, dB, of the pixels that no training saw; None if there are none.

        At most `MAX_EVALUATED` of ``views``, evenly spread, are evaluated.
        """
        few, engine = spread(views, MAX_EVALUATED), self._engine
        fits = evaluate_views(
            self.scene, few, self.exposure, self.formations, moving=self.moving, engine=engine
        )
        return pooled_unseen(fits)

    def static_mask(self, view: TrainingView, mask: MaskBool | None) -> MaskBool | None:
        """Return ``mask`` without the pixels in which something moves; None: all pixels count."""
        if view.frame_id not in self.moving:
            return mask
        pixels = static_pixels(self.moving[view.frame_id], view.camera.height, view.camera.width)
        return pixels if mask is None else pixels & mask

    def explained(self, view: TrainingView) -> Explained | None:
        """Return the training's explanation of a frame; None without a model of the frame."""
        formation = self.formations.get(view.frame_id)
        if formation is None or formation.model == "none":
            return None
        return Explained(self.formed(view).numpy(), formation, self._weights[view.frame_id])

    def deblur(self, view: TrainingView) -> Deblurred | None:
        """Return the frame image without its motion or defocus; None if no model explains the frame.

        If the training has estimated the formation of the frame, that is used. Otherwise it is estimated
        here.
        """
        observed, mask = observed_image(view)
        affine = self._affine(view)
        found = self.formations.get(view.frame_id, FrameFormation(view.frame_id))
        if found.steps == 0:
            found = fit_motion(
                found,
                FormationConfig(),
                Shot(
                    view.camera,
                    affine,
                    torch.from_numpy(observed),
                    None if mask is None else torch.from_numpy(mask),
                    self._with_depth,
                ),
                Terms(
                    low_weight=True,
                    shutter="rolling" if rolls(self.formations.values()) else "global",
                    measured=self.motions.get(view.frame_id),
                ),
            )
        if found.model == "none":
            return None
        formed = FormedView(view.camera, 1.0, affine=affine, formation=found, global_shutter=True)
        return Deblurred(_deblurred(formed, self._with_depth(formed.camera), observed, mask), found)

    def formed_layers(self, view: TrainingView, factor: float = 1.0) -> dict[str, ImageF32]:
        """Return two images of a frame at scale ``factor``: without its motion, and as the scene explains it.

        The layers are named as in an EXR, ``deblurred`` and ``explained``. Without a model of the frame there
        are none.
        """
        formation = self.formations.get(view.frame_id)
        if formation is None or formation.model == "none":
            return {}
        observed, mask = observed_image(view)
        camera = view.camera.scaled(factor)
        if factor < 1.0:
            size = camera.width, camera.height
            observed = np.asarray(cv2.resize(observed, size, interpolation=cv2.INTER_AREA))
            if mask is not None:
                mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        seen, formed = (
            FormedView(
                camera,
                1.0,
                affine=self._affine(view),
                formation=formation,
                factor=factor,
                global_shutter=stopped,
            )
            for stopped in (False, True)
        )
        render = self._with_depth(seen.camera)
        explained = seen.forward(render).clamp(0.0, 1.0).cpu().numpy()
        if seen.camera.readout is not None:
            render = self._with_depth(formed.camera)
        return {"deblurred": _deblurred(formed, render, observed, mask), "explained": explained}

    def _affine(self, view: TrainingView) -> Tensor | None:
        if self.exposure is None:
            return None
        return torch.from_numpy(self.exposure.of(view.frame_id).astype(np.float32))

    def _with_depth(self, camera: Camera) -> Render:
        return self._engine.view(self.scene, camera, depth=True)


def _deblurred(formed: FormedView, render: Render, observed: ImageF32, mask: MaskBool | None) -> ImageF32:
    """Return ``observed`` without its motion; ``render`` is the scene at the camera of ``formed``."""
    shown = render.image
    if formed.affine is not None:
        shown = backend_for(shown.device).apply_affine(shown, formed.affine)
    weight = np.ones(observed.shape[:2], np.float32) if mask is None else mask.astype(np.float32)
    return deblur(shown.clamp(0.0, 1.0).cpu().numpy(), observed, weight, formed.warp(render))
