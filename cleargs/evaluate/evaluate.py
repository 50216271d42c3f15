"""Evaluate a scene, or the images of any other method, against sharp reference images."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import cv2
import numpy as np
import torch

from cleargs.capture.folders import image_files
from cleargs.digest import file_digest
from cleargs.errors import InputError, StoreError
from cleargs.evaluate import metrics
from cleargs.evaluate.config import EvalOptions
from cleargs.evaluate.eval_report import Evaluation, ImageResult, Refinement, mean_of, split_hash
from cleargs.evaluate.references import Reference, ReferenceView, matching
from cleargs.evaluate.refinement import refine_pose
from cleargs.files import disk_errors
from cleargs.formation.frame import filmed_as
from cleargs.formation.observed import FormedView
from cleargs.manifest import versions
from cleargs.media.exr import read_depth
from cleargs.media.image import read_rgb, to_uint8, write_rgb
from cleargs.models.lpips import one_thread
from cleargs.models.onnx import installed_runtimes
from cleargs.plugins import installed_version
from cleargs.progress import Reporter
from cleargs.scene.folder import SceneFolder
from cleargs.splat.backend import decibels, rasteriser_for, set_threads
from cleargs.splat.camera import Camera
from cleargs.splat.formats import read_scene
from cleargs.splat.ply import READ
from cleargs.splat.scene import Scene
from cleargs.types import ArrayF64, ImageU8, MaskBool, PlaneF32

IN_FRONT = 0.85
"""Depth, divided by that of the true surface, below which the centre of a Gaussian is in front of it."""

_LIBRARIES = ("torch", "numpy", "numba", "opencv-contrib-python-headless")


@dataclass(frozen=True, eq=False)
class _Prediction:
    """Image of a method at a reference's view, before colour alignment."""

    image: ArrayF64  # [H, W, 3] sRGB in [0, 1]
    over_white: ArrayF64 | None = None
    """The same render over white; None for finished images."""
    refinement: Refinement | None = None
    far: MaskBool | None = None
    """Pixels in which a scene shows something behind the sparse points; None if these are not known."""
    covered: float | None = None
    """See `covered_share`; None if the true depth is not known."""
    as_filmed: ArrayF64 | None = None
    """The render with the measured motion during readout and exposure; None if none was measured."""


Predict = Callable[[ReferenceView, ImageU8, MaskBool | None], _Prediction]


def evaluate_scene(
    scene: Path,
    reference: Reference,
    *,
    options: EvalOptions,
    threads: int,
    reporter: Reporter,
    subject: str | None = None,
    save: Path | None = None,
) -> Evaluation:
    """Render the file ``scene`` at every view of ``reference``, without exposure affines, and measure.

    ``subject`` is its name in the result (None: that of the file). ``save`` is a folder for the evaluated
    images. Results do not depend on ``threads``. Raises InputError if the file is not a scene.
    """
    try:
        loaded = read_scene(scene)
    except StoreError as error:
        raise InputError(
            f"{scene} is not a scene of Gaussians: {str(error).split(': ', 1)[-1]}", hint=READ
        ) from error
    set_threads(threads)
    renderer = _renderer(loaded, options.refine_poses, reference.points, exposure_of(scene.parent))
    name = subject or scene.name
    return _evaluate(name, file_digest(scene), renderer, reference, options, threads, reporter, save)


def evaluate_images(
    folder: Path,
    reference: Reference,
    *,
    options: EvalOptions,
    threads: int,
    reporter: Reporter,
    save: Path | None = None,
) -> Evaluation:
    """Measure the images in ``folder``, of any method, matched with the references by their stems.

    The other arguments are those of `evaluate_scene`. Raises InputError if no stem matches, or if an image
    cannot be read or has another size than its reference.
    """
    if options.refine_poses:
        raise InputError("finished images have no pose to refine", hint="leave out --refine-poses")
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder of images", hint="give the folder of rendered images")
    files = {path.stem: path for path in sorted(image_files(folder))}
    names = matching(files, [view.name for view in reference.views], "name the images like the references")
    matched = tuple(view for view in reference.views if view.name in names)

    def predict(view: ReferenceView, target: ImageU8, mask: MaskBool | None) -> _Prediction:
        image = read_rgb(files[view.name])
        if image.shape != target.shape:
            raise InputError(
                f"{files[view.name]} has {image.shape[1]}x{image.shape[0]} pixels, "
                f"its reference {target.shape[1]}x{target.shape[0]}",
                hint="render at the size of the references (undistorted, where they have distortion)",
            )
        return _Prediction(image / 255.0)

    restricted = replace(reference, views=matched)
    found = _evaluate(folder.resolve().name, None, predict, restricted, options, threads, reporter, save)
    if len(matched) < len(reference.views):
        reporter.warn(
            f"{folder} has images for {len(matched)} of {len(reference.views)} references: "
            "the means are over these"
        )
    return found


def exposure_of(folder: Path) -> float:
    """Return the median exposure time, s, that a training found with measured motions; 0 if it is unknown."""
    rows = SceneFolder(folder).formation_rows().values()
    times = [row["exposure_s"] for row in rows if row.get("exposure_s")]
    return median(times) if times else 0.0


def _renderer(scene: Scene, refine_steps: int, points: ArrayF64 | None, exposure_s: float = 0.0) -> Predict:
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

    def predict(view: ReferenceView, target: ImageU8, mask: MaskBool | None) -> _Prediction:
        camera, refinement, far = view.camera, None, None
        if refine_steps:
            depth, alpha = depth_and_alpha(camera)
            shown = alpha > 0.5
            distance = float(np.median(depth[shown] / alpha[shown])) if shown.any() else 1.0
            camera, refinement = refine_pose(
                lambda camera: render(camera)[int(view.cut_out)], camera, distance, target, mask, refine_steps
            )
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
        filmed = None
        if view.path is not None and (view.path.rolls or exposure_s > 0.0):
            formed = FormedView(camera, 1.0, formation=filmed_as(view.path.exposed(exposure_s, camera)))
            seen = formed.forward(engine.view(scene, formed.camera, depth=True))
            filmed = seen.clamp(0.0, 1.0).numpy().astype(np.float64)
        return _Prediction(*render(camera), refinement, far, covered, filmed)

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


def _evaluate(
    subject: str,
    scene: str | None,
    predict: Predict,
    reference: Reference,
    options: EvalOptions,
    threads: int,
    reporter: Reporter,
    save: Path | None,
) -> Evaluation:
    """Make predictions one after the other (a render uses all threads), and measure them in parallel."""
    measures = metrics.load_metrics(options)
    if save is not None:
        with disk_errors(save):
            save.mkdir(parents=True, exist_ok=True)

    def measured(name: str, prediction: _Prediction, target: ImageU8, mask: MaskBool | None) -> ImageResult:
        image, affine, aligned_psnr = prediction.image, None, None
        fitted = metrics.fit_affine(image, target / 255.0, mask)
        aligned = metrics.apply_affine(image, fitted)
        if options.align_colour:
            image, affine = aligned, fitted
        else:
            aligned_psnr = metrics.psnr(to_uint8(aligned), target, mask)
        pixels, white = to_uint8(image), prediction.over_white
        if save is not None:
            write_rgb(save / f"{name}.png", pixels)
        return ImageResult(
            name=name,
            width=pixels.shape[1],
            height=pixels.shape[0],
            values=measures.measure(pixels, target, mask),
            prediction=_digest(pixels),
            reference=_digest(target, mask),
            colour=None if affine is None else tuple(tuple(row) for row in affine.tolist()),
            psnr_colour_aligned=aligned_psnr,
            psnr_white=None if white is None else metrics.psnr(to_uint8(white), target, mask),
            psnr_between=None
            if white is None
            else decibels(float(np.square(white - prediction.image).sum()), white.size),
            refinement=prediction.refinement,
            far=None if prediction.far is None else metrics.region(pixels, target, prediction.far, mask),
            clipped=metrics.region(pixels, target, metrics.clipped_pixels(target), mask),
            covered=prediction.covered,
            psnr_as_filmed=None
            if prediction.as_filmed is None
            else metrics.psnr(to_uint8(prediction.as_filmed), target, mask),
        )

    images: list[ImageResult] = []
    waiting: deque[Future[ImageResult]] = deque()
    with (
        reporter.task(f"evaluating {subject}", len(reference.views)) as task,
        one_thread(),
        ThreadPoolExecutor(threads) as pool,
    ):
        for view in reference.views:
            target, mask = view.load()
            prediction = predict(view, target, mask)
            if view.cut_out and prediction.over_white is not None:
                prediction = replace(prediction, image=prediction.over_white)
            waiting.append(pool.submit(measured, view.name, prediction, target, mask))
            if len(waiting) > 2 * threads:  # so that memory does not grow with the number of images
                images.append(waiting.popleft().result())
                task.advance()
        for future in waiting:
            images.append(future.result())
            task.advance()
    return Evaluation(
        subject=subject,
        scene=scene,
        reference=reference.name,
        split=split_hash({image.name: image.reference for image in images}),
        poses=reference.poses,
        alignment=reference.alignment,
        options=options,
        means={metric: mean_of(image.values[metric] for image in images) for metric in options.metrics},
        psnr_colour_aligned=mean_of(image.psnr_colour_aligned for image in images),
        psnr_white=mean_of(image.psnr_white for image in images),
        psnr_between=mean_of(image.psnr_between for image in images),
        far=metrics.pooled(image.far for image in images),
        clipped=metrics.pooled(image.clipped for image in images),
        covered=mean_of(image.covered for image in images),
        psnr_as_filmed=mean_of(image.psnr_as_filmed for image in images),
        unavailable=measures.unavailable,
        weights=measures.weights,
        versions={
            **versions(),
            **{name: installed_version(name) for name in _LIBRARIES},
            "onnxruntime": installed_runtimes(),
        },
        images=tuple(images),
    )


def _digest(pixels: ImageU8, mask: MaskBool | None = None) -> str:
    """Return the SHA-256 of decoded pixels and mask: the same for every lossless way to store them."""
    digest = hashlib.sha256(f"{pixels.shape}".encode())
    digest.update(np.ascontiguousarray(pixels).tobytes())
    if mask is not None:
        digest.update(np.packbits(mask).tobytes())
    return digest.hexdigest()
