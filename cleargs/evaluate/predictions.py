"""The image of a scene at a reference's view, and the other measures of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import torch

from cleargs.errors import InputError
from cleargs.evaluate import metrics
from cleargs.evaluate.eval_report import Refinement
from cleargs.evaluate.reference_views import ReferenceView
from cleargs.evaluate.refinement import refine_pose
from cleargs.formation.capture import MIN_EXPOSED_FRAMES
from cleargs.formation.formed import FormedView
from cleargs.formation.frame import filmed_as
from cleargs.media.exr import read_depth
from cleargs.scene.folder import SceneFolder
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.scene import Scene
from cleargs.types import ArrayF64, ImageU8, MaskBool, PlaneF32

IN_FRONT = 0.85
"""Depth, divided by that of the true surface, below which the centre of a Gaussian is in front of it."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Image of a method at a reference's view, before colour alignment."""

    image: ArrayF64  # [H, W, 3] sRGB in [0, 1]
    over_white: ArrayF64 | None = None
    """The same render over white; None for finished images."""
    refinement: Refinement | None = None
    far: MaskBool | None = None
    """Pixels in which a scene shows something behind the sparse points; None if these are not known."""
    covered: float | None = None
    """See `covered_share`; None if the true depth is not known."""
    formed: ArrayF64 | None = None
    """The render with the measured motion during readout and exposure; None if none was measured."""


Predict = Callable[[ReferenceView, ImageU8, MaskBool | None], Prediction]


def exposure_of(folder: Path) -> float:
    """Return the median exposure time, s, that a training found with measured motions; 0 if it is unknown.

    Fewer than `MIN_EXPOSED_FRAMES` frames do not show it: one frame of 52 sharp ones that got a blur by
    chance would blur all renders. Unlike the training, short blurs count, too.
    """
    rows = SceneFolder(folder).formation_rows().values()
    times = [row["exposure_s"] for row in rows if row.get("exposure_s")]
    return median(times) if len(times) >= MIN_EXPOSED_FRAMES else 0.0


def renderer(scene: Scene, refine_steps: int, points: ArrayF64 | None, exposure_s: float = 0.0) -> Predict:
    """Return a function that renders a scene at references' views, with poses refined in ``refine_steps``.

    ``exposure_s`` is the exposure time, s, for renders as the camera took the frames.
    """
    engine = rasteriser_for(scene.gaussians.device)

    def render(camera: Camera) -> tuple[ArrayF64, ArrayF64]:
        """Return the image over the scene's background, and over white."""
        image, alpha, _ = engine.view(scene, camera)
        pixels, through = image.numpy().astype(np.float64), 1.0 - alpha.numpy().astype(np.float64)
        white = pixels + through[..., None] * (1.0 - np.array(scene.background))
        return pixels.clip(0.0, 1.0), white.clip(0.0, 1.0)

    def depth_and_alpha(camera: Camera) -> tuple[PlaneF32, PlaneF32]:
        rendered = engine.forward(scene.gaussians, camera, antialias=scene.antialias, depth=True)
        assert rendered.depth is not None  # asked for
        return rendered.depth.numpy(), rendered.alpha.numpy()

    def predict(view: ReferenceView, target: ImageU8, mask: MaskBool | None) -> Prediction:
        def plain(camera: Camera) -> ArrayF64:
            return render(camera)[int(view.cut_out)]

        def as_filmed(camera: Camera) -> ArrayF64:
            assert view.path is not None
            formed = FormedView(camera, 1.0, formation=filmed_as(view.path.exposed(exposure_s, camera)))
            seen = formed.forward(engine.view(scene, formed.camera, depth=True))
            return seen.clamp(0.0, 1.0).numpy().astype(np.float64)

        camera = filmed_by = view.camera
        refinement, far = None, None
        moves = view.path is not None and (view.path.rolls or exposure_s > 0.0)
        if refine_steps:
            depth, alpha = depth_and_alpha(camera)
            shown = alpha > 0.5
            distance = float(np.median(depth[shown] / alpha[shown])) if shown.any() else 1.0
            if moves:  # the pose that fits a render without the motion makes up for a part of it
                filmed_by, _ = refine_pose(as_filmed, camera, distance, target, mask, refine_steps)
            camera, refinement = refine_pose(plain, camera, distance, target, mask, refine_steps)
        farthest = None if points is None else metrics.depth_of_points(points, camera)
        if farthest is not None:
            far = metrics.far_pixels(*depth_and_alpha(camera), farthest)
        covered = None
        if view.depth is not None:
            surface = read_depth(view.depth)
            if surface.shape != (camera.height, camera.width):
                raise InputError(
                    f"{view.depth} has {surface.shape[1]}x{surface.shape[0]} pixels, "
                    f"its image {camera.width}x{camera.height}",
                    hint="delete the depth, or write it at the size of the images",
                )
            covered = covered_share(scene, camera, surface / view.unit, mask)
        filmed = as_filmed(filmed_by) if moves else None
        return Prediction(*render(camera), refinement, far, covered, filmed)

    return predict


def covered_share(scene: Scene, camera: Camera, depth: PlaneF32, mask: MaskBool | None) -> float:
    """Return the mean alpha, over the pixels that count, of the Gaussians in front of the true surface.

    These are the Gaussians whose centre is nearer than `IN_FRONT` times the nearest surface around it.
    ``depth`` [H, W] is the true one, in units of the scene; 0 where there is no surface.
    """
    means = scene.gaussians.means.numpy().astype(np.float64)
    pose = camera.world_to_camera
    x, y, z = np.einsum("ij,nj->in", pose[:3, :3], means) + pose[:3, 3:]
    ahead = np.maximum(z, 1e-6)
    column, row = np.floor(x / ahead * camera.fx + camera.cx), np.floor(y / ahead * camera.fy + camera.cy)
    inside = (z > 0.0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    at = np.where(inside, row, 0).astype(np.intp), np.where(inside, column, 0).astype(np.intp)
    nearest = cv2.erode(depth, np.ones((5, 5), np.uint8))
    front = torch.from_numpy(inside & (z < IN_FRONT * nearest[at]))
    if not bool(front.any()):
        return 0.0
    fewer = replace(scene, gaussians=scene.gaussians.select(front))
    alpha = rasteriser_for("cpu").view(fewer, camera).alpha.numpy().astype(np.float64)
    counting = alpha if mask is None else alpha[mask]
    return float(counting.mean()) if counting.size else 0.0
