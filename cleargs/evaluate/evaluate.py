"""Evaluate a scene, or the images of any other method, against sharp reference images."""

from __future__ import annotations

import hashlib
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from cleargs.capture.folders import image_files
from cleargs.digest import file_digest
from cleargs.errors import InputError, StoreError
from cleargs.evaluate import metrics
from cleargs.evaluate.config import EvalOptions
from cleargs.evaluate.eval_report import Evaluation, ImageResult, mean_of, split_hash
from cleargs.evaluate.predictions import Predict, Prediction, exposure_of, renderer
from cleargs.evaluate.reference_views import ReferenceView
from cleargs.evaluate.references import Reference, matching
from cleargs.files import disk_errors
from cleargs.manifest import versions
from cleargs.media.image import read_rgb, to_uint8, write_rgb
from cleargs.models.onnx import installed_runtimes
from cleargs.plugins import installed_version
from cleargs.progress import Reporter
from cleargs.splat.backend import decibels, set_threads
from cleargs.splat.formats import read_scene
from cleargs.splat.ply import READ
from cleargs.torch_threads import one_thread
from cleargs.types import ImageU8, MaskBool

_LIBRARIES = ("torch", "numpy", "numba", "opencv-contrib-python-headless")


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
    predict = renderer(loaded, options.refine_poses, reference.points, exposure_of(scene.parent))
    name = subject or scene.name
    return _evaluate(name, file_digest(scene), predict, reference, options, threads, reporter, save)


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

    def predict(view: ReferenceView, target: ImageU8, mask: MaskBool | None) -> Prediction:
        image = read_rgb(files[view.name])
        if image.shape != target.shape:
            raise InputError(
                f"{files[view.name]} has {image.shape[1]}x{image.shape[0]} pixels, "
                f"its reference {target.shape[1]}x{target.shape[0]}",
                hint="render at the size of the references (undistorted, where they have distortion)",
            )
        return Prediction(image / 255.0)

    restricted = replace(reference, views=matched)
    found = _evaluate(folder.resolve().name, None, predict, restricted, options, threads, reporter, save)
    if len(matched) < len(reference.views):
        reporter.warn(
            f"{folder} has images for {len(matched)} of {len(reference.views)} references: "
            "the means are over these"
        )
    return found


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
    with reporter.task("loading the metrics"):
        measures = metrics.load_metrics(options)
    if save is not None:
        with disk_errors(save):
            save.mkdir(parents=True, exist_ok=True)

    def measured(name: str, prediction: Prediction, target: ImageU8, mask: MaskBool | None) -> ImageResult:
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
            formed={}
            if prediction.formed is None
            else measures.measure(to_uint8(prediction.formed), target, mask),
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
        formed={
            metric: mean_of(image.formed.get(metric) for image in images)
            for metric in options.metrics
            if any(image.formed for image in images)
        },
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
