"""Points matched between frames lie on the surfaces of the scene."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cleargs.splat.camera import Camera, look_at
from cleargs.splat.initialise import starting_gaussians
from cleargs.splat.matched_points import add_matched_points
from cleargs.splat.sparse_points import SparsePoints
from cleargs.splat.views import TrainingView
from cleargs.types import ImageU8

WIDTH, HEIGHT, FOCAL, DEPTH = 160, 120, 150.0, 3.0
TEXELS = 100.0  # per unit of the wall


def wall(camera: Camera, texture: ImageU8) -> ImageU8:
    """Return the image [H, W, 3] of a textured wall at z = DEPTH."""
    centre, turn = camera.centre, camera.world_to_camera[:3, :3]
    row, column = np.indices((HEIGHT, WIDTH))
    rays = np.stack(
        [(column + 0.5 - camera.cx) / FOCAL, (row + 0.5 - camera.cy) / FOCAL, np.ones(row.shape)], -1
    )
    rays = rays @ turn
    place = centre + rays * ((DEPTH - centre[2]) / rays[..., 2])[..., None]
    u, v = ((place[..., k] * TEXELS + 400).astype(np.float32) for k in range(2))
    return np.asarray(cv2.remap(texture, u, v, cv2.INTER_LINEAR), np.uint8)


def views_of_wall(count: int = 3, step: float = 0.2) -> list[TrainingView]:
    rng = np.random.default_rng(4)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (800, 800, 3)).astype(np.float32), (0, 0), 4.0)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    views = []
    for k in range(count):
        pose = look_at(
            np.array([step * k, 0.25 * step * k, 0.0]), np.array([0.1, 0.0, DEPTH]), np.array([0.0, -1, 0])
        )
        camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)
        image = wall(camera, texture)
        views.append(TrainingView(k, camera, 1.0, "real", lambda image=image: (image, None)))
    return views


def seen_by_all(views: list[TrainingView]) -> SparsePoints:
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 5), np.linspace(-0.4, 0.4, 5))
    xyz = np.stack([x.ravel(), y.ravel(), np.full(x.size, DEPTH)], axis=1)
    return SparsePoints(xyz, np.zeros((len(xyz), 3), np.uint8), [np.arange(len(xyz)) for _ in views])


def test_matched_points_lie_on_the_wall_with_its_colours() -> None:
    views = views_of_wall()
    sparse = seen_by_all(views)
    found = add_matched_points(sparse, views, 3000, seed=0)
    new, colours = found.xyz[len(sparse.xyz) :], found.rgb[len(sparse.rgb) :]
    assert len(new) == 3000 == len(colours)
    off = np.abs(new[:, 2] - DEPTH) / DEPTH
    assert np.median(off) < 0.005 and np.quantile(off, 0.95) < 0.03
    assert [len(seen) for seen in found.observed] == [25, 25, 25]
    first = views[0].camera
    x, y, z = first.world_to_camera[:3, :3] @ new.T + first.world_to_camera[:3, 3:]
    column, row = FOCAL * x / z + first.cx, FOCAL * y / z + first.cy
    inside = (column > 1) & (column < WIDTH - 1) & (row > 1) & (row < HEIGHT - 1)
    image = views[0].load()[0].astype(float)
    shown = image[row[inside].astype(int), column[inside].astype(int)]
    assert np.median(np.abs(shown - colours[inside])) < 8


def test_ignored_and_transparent_pixels_give_no_points() -> None:
    views = views_of_wall()
    left = np.zeros((HEIGHT, WIDTH), np.bool_)
    left[:, : WIDTH // 2] = True
    masked = [replace(v, load=lambda v=v: (v.load()[0], left)) for v in views]
    cut_out = [replace(v, transparency=lambda: left.astype(np.uint8) * 255) for v in views]
    for kind in (masked, cut_out):
        sparse = seen_by_all(kind)
        new = add_matched_points(sparse, kind, 3000, seed=0).xyz[25:]
        assert len(new) > 100
        columns = []
        for view in kind:
            x, _, z = view.camera.world_to_camera[:3, :3] @ new.T + view.camera.world_to_camera[:3, 3:]
            columns.append(FOCAL * x / z + view.camera.cx)
        assert np.min(columns, axis=0).max() < WIDTH // 2 + 1


def test_the_threads_of_opencv_change_nothing() -> None:
    views = views_of_wall()
    before = cv2.getNumThreads()
    results = []
    try:
        for threads in (1, 2):
            cv2.setNumThreads(threads)
            results.append(add_matched_points(seen_by_all(views), views, 500, seed=1).xyz)
            assert cv2.getNumThreads() == threads
    finally:
        cv2.setNumThreads(before)
    np.testing.assert_array_equal(*results)


@pytest.mark.parametrize("step", [0.0, 4.0])
def test_frames_from_one_spot_or_far_apart_are_not_matched(step: float) -> None:
    """The start then has points at random depths in their place."""
    views = views_of_wall(2, step)
    sparse = seen_by_all(views)
    said: list[str] = []
    start = starting_gaussians(
        sparse, views, at_least=200, at_most=None, sh_degree=0, seed=0, say=said.append
    )
    assert start.num == 200 and said == ["starting from 25 sparse, 0 matched and 175 random points"]
