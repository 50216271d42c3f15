"""Points between the sparse ones: pixels of two frames matched by dense optical flow, and triangulated.

A training that starts from them needs fewer steps than one whose Gaussians must first spread (compare EDGS,
Kotovenko et al. 2025, which matches with a neural network).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.media.image import to_uint8
from cleargs.random_streams import Stream
from cleargs.splat.camera import Camera
from cleargs.splat.sparse_points import SparsePoints
from cleargs.splat.views import TrainingView
from cleargs.types import ArrayF64, ImageU8, MaskBool

MAX_VIEWS, MAX_SIDE = 60, 640
"""Greatest number of frames that are matched, evenly spread, and their longer side, px."""
MIN_SHARED = 10
"""Least number of sparse points that two frames must both see."""
MIN_ANGLE, GOOD_ANGLE, MAX_ANGLE = 1.0, 4.0, 20.0
"""Angles between two frames, degrees, as their shared points see them (median): below the first, depth is
uncertain; up to the second, larger is better; above the third, flow fails."""
MAX_MISS = 1.0
"""Greatest distance, px, between a pixel and the return of its flow, or the image of its point."""
MIN_DEPTH = 0.05
"""Least depth of a point, in units of the normalised world."""


def add_matched_points(
    sparse: SparsePoints, views: Sequence[TrainingView], count: int, *, seed: int
) -> SparsePoints:
    """Add up to ``count`` points, as evenly over the frames as their matches allow. They are not observed."""
    found = []
    for k in np.unique(np.linspace(0, len(views) - 1, MAX_VIEWS).round().astype(int)).tolist():
        if (partner := _partner(sparse, views, k)) is not None:
            with _one_thread():
                found.append(_triangulated(views[k], views[partner]))
    rng = np.random.default_rng([seed, Stream.MATCHED_POINTS])
    xyz, rgb = [sparse.xyz], [sparse.rgb]
    left = count
    for number, (points, colours) in enumerate(sorted(found, key=lambda pair: len(pair[0]))):
        share = min(len(points), left // (len(found) - number))
        chosen = np.sort(rng.permutation(len(points))[:share])
        xyz.append(points[chosen])
        rgb.append(colours[chosen])
        left -= share
    return replace(sparse, xyz=np.concatenate(xyz), rgb=np.concatenate(rgb))


def _partner(sparse: SparsePoints, views: Sequence[TrainingView], k: int) -> int | None:
    """Return the frame with which frame ``k`` is matched best: it is reliable, near, and not too near."""
    best, partner = 0.0, None
    seen = np.zeros(len(sparse.xyz), np.bool_)
    seen[sparse.observed[k]] = True
    for other, view in enumerate(views):
        shared = sparse.observed[other][seen[sparse.observed[other]]]
        if other == k or len(shared) < MIN_SHARED:
            continue
        one, two = views[k].camera.centre - sparse.xyz[shared], view.camera.centre - sparse.xyz[shared]
        cosine = np.sum(one * two, axis=1) / np.linalg.norm(one, axis=1) / np.linalg.norm(two, axis=1)
        angle = float(np.degrees(np.arccos(np.clip(np.median(cosine), -1.0, 1.0))))
        score = view.weight * len(shared) * min(1.0, angle / GOOD_ANGLE)
        if MIN_ANGLE <= angle <= MAX_ANGLE and score > best:
            best, partner = score, other
    return partner


def _triangulated(view: TrainingView, partner: TrainingView) -> tuple[ArrayF64, NDArray[np.uint8]]:
    """Return positions [P, 3] and colours [P, 3] of the pixels of ``view`` that the partner sees too."""
    one, image, counts = _reduced(view)
    two, other, _ = _reduced(partner)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey, grey_other = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (image, other))
    there, back = (
        flow.calc(a, b, np.zeros((*a.shape, 2), np.float32))
        for a, b in ((grey, grey_other), (grey_other, grey))
    )
    row, column = np.indices(grey.shape, dtype=np.float32)
    place = np.stack([column, row], axis=-1) + there
    returned = cv2.remap(
        back, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1e6
    )
    counts &= np.linalg.norm(there + returned, axis=-1) < MAX_MISS
    rows, columns = np.nonzero(counts)
    pixels = np.stack([columns, rows], axis=1).astype(np.float64) + 0.5
    matched = place[rows, columns].astype(np.float64) + 0.5

    ray, ray_other = _rays(one, pixels), _rays(two, matched)
    between = two.centre - one.centre
    # Points of both rays that are nearest to each other; the point is in their middle.
    cosine = np.einsum("ni,ni->n", ray, ray_other)
    # einsum, not BLAS, whose order of summation may depend on its threads.
    along, along_other = (np.einsum("ni,i->n", rays, between) for rays in (ray, ray_other))
    sine_squared = np.maximum(1.0 - cosine**2, 1e-12)
    depth = (along - cosine * along_other) / sine_squared
    depth_other = (cosine * along - along_other) / sine_squared
    points = 0.5 * (one.centre + depth[:, None] * ray + two.centre + depth_other[:, None] * ray_other)
    near = np.minimum(depth, depth_other) > MIN_DEPTH
    wide = sine_squared > np.sin(np.radians(MIN_ANGLE)) ** 2
    miss = np.maximum(_distance(one, points, pixels), _distance(two, points, matched))
    kept = near & wide & (miss < MAX_MISS)
    return points[kept], image[rows, columns][kept]


def _reduced(view: TrainingView) -> tuple[Camera, ImageU8, MaskBool]:
    """Return camera, image and the pixels that count, with sides of at most `MAX_SIDE`."""
    pixels, mask = view.load()
    alpha = None if view.transparency is None else view.transparency()
    counts = np.ones(pixels.shape[:2], np.uint8) if mask is None else mask.astype(np.uint8)
    if alpha is not None:
        counts &= (alpha > 127).astype(np.uint8)
    image, camera = to_uint8(pixels), view.camera
    if (factor := MAX_SIDE / max(camera.width, camera.height)) < 1.0:
        camera = camera.scaled(factor)
        size = camera.width, camera.height
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        counts = np.asarray(cv2.resize(counts, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    return camera, image, counts > 0


def _rays(camera: Camera, pixels: ArrayF64) -> ArrayF64:
    """Return the directions [P, 3] of pixels [P, 2] in the world, of length 1."""
    offset = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    rays = np.column_stack([offset, np.ones(len(pixels))])
    turned = np.einsum("ni,ij->nj", rays, camera.world_to_camera[:3, :3])
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def _distance(camera: Camera, points: ArrayF64, pixels: ArrayF64) -> ArrayF64:
    """Return the distances, px, between the images of points [P, 3] and pixels [P, 2]."""
    pose = camera.world_to_camera
    x, y, z = np.einsum("ij,nj->in", pose[:3, :3], points) + pose[:3, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        image = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    return np.asarray(np.linalg.norm(image - pixels, axis=1))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let OpenCV work on one thread: its dense flow depends on the number of threads."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
