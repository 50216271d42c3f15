"""Initial Gaussians of a training: one per sparse point, and more in between if there are few points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cleargs.media.image import to_uint8
from cleargs.random_streams import Stream
from cleargs.splat.config import INIT_OPACITY, INIT_SCALE
from cleargs.splat.constants import SH_C0
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.matched_points import add_matched_points
from cleargs.splat.sparse_points import SparsePoints
from cleargs.splat.views import TrainingView

NEIGHBOURS = 3
"""Number of neighbours that set the initial scale (mean distance, Inria) and the depth of added points."""

DEPTH_JITTER = 0.05
"""Standard deviation of the noise on the log depth of added points."""

BLIND_DEPTHS = (0.5, 5.0)
"""Range of depths of added points if a view observes no sparse point (the cameras span a radius of 1)."""


def starting_gaussians(
    sparse: SparsePoints,
    views: Sequence[TrainingView],  # in the order of ``sparse.observed``
    *,
    at_least: int,
    at_most: int | None,  # None: no limit
    sh_degree: int | None,  # None: `sh_degree_from_views`
    seed: int,
    say: Callable[[str], None] = lambda remark: None,
) -> Gaussians:
    """Return the Gaussians that a training starts from, one per sparse point.

    Missing ones are matched between the views (`add_matched_points`), and the rest are added behind random
    pixels. If there are too many points, a random subset is used. ``say`` receives a message in both cases.
    """
    most = at_most or max(at_least, len(sparse.xyz))
    if len(sparse.xyz) > most:
        say(f"using {most} of {len(sparse.xyz)} sparse points (limit: g0.budget)")
        sparse = subsample_points(sparse, most, seed=seed)
    known = len(sparse.xyz)
    if (missing := min(at_least, most) - known) > 0:
        sparse = add_matched_points(sparse, views, missing, seed=seed)
        matched = len(sparse.xyz) - known
        if (missing := missing - matched) > 0:
            sparse = add_points(sparse, views, missing, seed=seed)
        say(f"starting from {known} sparse, {matched} matched and {missing} random points")
    if sh_degree is None:
        sh_degree = sh_degree_from_views(len(views))
    return from_points(sparse, sh_degree)


def sh_degree_from_views(count: int) -> int:
    """Return the SH degree for ``count`` active frames: 0 below 12, 1 below 40, 2 below 100, then 3.

    Few directions of view determine few terms. Further terms would overfit single frames, and cost time.
    """
    return 0 if count < 12 else 1 if count < 40 else 2 if count < 100 else 3


def from_points(sparse: SparsePoints, sh_degree: int) -> Gaussians:
    """Return one isotropic Gaussian per point.

    The scale is `INIT_SCALE` times the mean distance to the three nearest points. The colour sets the
    constant term of the SH.
    """
    xyz, rgb = sparse.xyz, sparse.rgb
    count = len(xyz)
    near = min(NEIGHBOURS, count - 1)
    spacing = np.ones(count)
    if near > 0:
        distances, _ = cKDTree(xyz).query(xyz, k=near + 1)
        spacing = distances[:, 1:].mean(axis=1)
    log_scales = np.log(np.maximum(spacing * INIT_SCALE, 1e-7))
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = torch.from_numpy(((rgb / 255.0 - 0.5) / SH_C0).astype(np.float32))
    rotations = torch.zeros(count, 4)
    rotations[:, 0] = 1.0
    return Gaussians(
        means=torch.from_numpy(xyz.astype(np.float32)),
        log_scales=torch.from_numpy(np.repeat(log_scales[:, None], 3, axis=1).astype(np.float32)),
        rotations=rotations,
        logit_opacities=torch.full((count,), float(np.log(INIT_OPACITY / (1.0 - INIT_OPACITY)))),
        sh=sh,
    )


def subsample_points(sparse: SparsePoints, count: int, *, seed: int) -> SparsePoints:
    """Return a random subset of ``count`` points, in their order."""
    rng = np.random.default_rng([seed, Stream.LEFT_OUT_POINTS])
    kept = np.sort(rng.permutation(len(sparse.xyz))[:count])
    new_row = np.full(len(sparse.xyz), -1)
    new_row[kept] = np.arange(count)
    observed = [new_row[seen][new_row[seen] >= 0] for seen in sparse.observed]
    return SparsePoints(sparse.xyz[kept], sparse.rgb[kept], observed)


def add_points(sparse: SparsePoints, views: Sequence[TrainingView], count: int, *, seed: int) -> SparsePoints:
    """Add ``count`` points, the same number behind random pixels of each view.

    Each point has the colour of an unmasked pixel. Its depth is the mean log depth of the three observed
    sparse points that project nearest to the pixel, plus noise (`DEPTH_JITTER`). If a view observes no sparse
    point, log depths are uniform between `BLIND_DEPTHS`. Added points are not observed.
    """
    shares = np.full(len(views), count // len(views))
    shares[: count % len(views)] += 1
    xyz, rgb = [sparse.xyz], [sparse.rgb]
    for view, seen, share in zip(views, sparse.observed, shares, strict=True):
        if share:
            rng = np.random.default_rng([seed, Stream.ADDED_POINTS, view.frame_id])
            added, colours = _points_of_view(view, sparse.xyz[seen], int(share), rng)
            xyz.append(added)
            rgb.append(colours)
    return replace(sparse, xyz=np.concatenate(xyz), rgb=np.concatenate(rgb))


def _points_of_view(
    view: TrainingView, seen: NDArray[np.float64], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return positions and colours of points behind random pixels of a view that sees ``seen`` [S, 3]."""
    camera = view.camera
    image, mask = view.load()
    rows, columns = np.nonzero(mask) if mask is not None else np.indices(image.shape[:2]).reshape(2, -1)
    if not len(rows):
        return np.empty((0, 3)), np.empty((0, 3), np.uint8)
    pick = rng.integers(len(rows), size=count)
    rows, columns = rows[pick], columns[pick]
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)

    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    in_camera = np.einsum("ni,ji->nj", seen, rotation) + translation
    in_camera = in_camera[in_camera[:, 2] > 1e-3]
    if len(in_camera):
        depth = in_camera[:, 2:]
        focal = np.array([camera.fx, camera.fy])
        projected = in_camera[:, :2] / depth * focal + np.array([camera.cx, camera.cy])
        near = min(NEIGHBOURS, len(in_camera))
        _, nearest = cKDTree(projected).query(pixels, k=[*range(1, near + 1)])
        log_depth = np.log(depth[:, 0])[nearest].mean(axis=1) + DEPTH_JITTER * rng.standard_normal(count)
    else:
        nearest_depth, farthest_depth = BLIND_DEPTHS
        log_depth = rng.uniform(np.log(nearest_depth), np.log(farthest_depth), size=count)

    rays = np.stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(count)],
        axis=1,
    )
    world = np.einsum("ni,ij->nj", rays * np.exp(log_depth)[:, None] - translation, rotation)
    return world, to_uint8(image[rows, columns])
