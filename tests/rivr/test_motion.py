"""The camera's motion during an exposure: found, and undone."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.rivr.motion.fit import fit_motion
from cleargs.rivr.motion.kernels import expose, spread
from cleargs.rivr.motion.model import TWIST, Motion, flow_basis, instants
from cleargs.rivr.motion.undo import as_photographed, deblur, undo_motion
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.runtime import set_threads

Image = npt.NDArray[np.float32]

HEIGHT, WIDTH = 150, 240
CAMERA = Camera(WIDTH, HEIGHT, 200.0, 204.0, 118.0, 77.0, np.eye(4))
STILL = np.zeros(TWIST)


@pytest.fixture(scope="module")
def depth() -> Image:
    """A slanted wall between 2 and 5 metres."""
    return np.linspace(2.0, 5.0, WIDTH, dtype=np.float32)[None].repeat(HEIGHT, 0)


@pytest.fixture(scope="module")
def truth() -> Image:
    """sRGB [H, W, 3]: polygons with anti-aliased borders."""
    rng = np.random.default_rng(5)
    canvas = np.full((2 * HEIGHT, 2 * WIDTH, 3), 0.4, np.float32)
    for _ in range(150):
        corners = rng.uniform(0, [2 * WIDTH, 2 * HEIGHT]) + rng.normal(0, 30, (5, 2))
        colour = rng.uniform(0.1, 0.9, 3).tolist()
        cv2.fillConvexPoly(canvas, cv2.convexHull(corners.astype(np.int32)), colour)
    return np.ascontiguousarray(cv2.resize(canvas, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))


def twist(*numbers: float) -> npt.NDArray[np.float64]:
    return np.array(numbers, np.float64)


def photograph(truth: Image, motion: Motion, depth: Image, *, noise: float = 1 / 255) -> Image:
    """What a camera that moves so records, with more instants than the code under test takes."""
    offset, sweep = motion.ways(flow_basis(CAMERA, depth))
    out = np.empty_like(truth)
    expose(linear_from_srgb(truth), offset, sweep, instants(101), out)
    grain = noise * np.random.default_rng(0).standard_normal(truth.shape)
    return np.clip(srgb_from_linear(out) + grain, 0, 1).astype(np.float32)


def soft(image: Image, sigma: float = 0.7) -> Image:
    """The render of an unfinished scene: smooth, and a little off in its colours."""
    return np.asarray(np.clip(cv2.GaussianBlur(image, (0, 0), sigma) * 0.98 + 0.01, 0, 1), np.float32)


def psnr(image: Image, truth: Image, border: int = 12) -> float:
    inner = np.s_[border:-border, border:-border]
    return float(-10.0 * np.log10(np.mean((image[inner] - truth[inner]) ** 2)))


def test_the_flow_is_that_of_a_small_camera_motion(depth: Image) -> None:
    """Points of the image carried by a twist of a tenth of a pixel's size land where the basis says."""
    basis = flow_basis(CAMERA, depth)
    y, x = np.indices(depth.shape) + 0.5
    rays = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones_like(x)], -1)
    points = rays * depth[..., None]
    for component in range(TWIST):
        small = np.zeros(TWIST)
        small[component] = 0.1 / CAMERA.fx
        moved = points - small[:3] * np.median(depth) - np.cross(small[3:], points)
        u = CAMERA.fx * moved[..., 0] / moved[..., 2] + CAMERA.cx
        v = CAMERA.fy * moved[..., 1] / moved[..., 2] + CAMERA.cy
        # What a linear flow of a tenth of a pixel neglects is of the second order: 1e-4 px here.
        np.testing.assert_allclose(0.1 * basis[component], np.stack([u - x, v - y]), atol=3e-4)


def test_the_flow_of_a_reduced_view_is_reduced(depth: Image) -> None:
    small = cv2.resize(depth, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
    full, half = flow_basis(CAMERA, depth), flow_basis(CAMERA, small)
    averaged = full.reshape(TWIST, 2, HEIGHT // 2, 2, WIDTH // 2, 2).mean((3, 5))
    np.testing.assert_allclose(half, averaged / 2, atol=2e-3)  # the mean of 1 / depth is not 1 / mean depth


def test_spread_is_the_transpose_of_expose(depth: Image) -> None:
    rng = np.random.default_rng(0)
    motion = Motion(rng.normal(0, 9, TWIST), rng.normal(0, 5, TWIST))
    offset, sweep = motion.ways(flow_basis(CAMERA, depth))
    a, b = (rng.standard_normal((HEIGHT, WIDTH, 3)).astype(np.float32) for _ in range(2))
    forth, back = np.empty_like(a), np.empty_like(b)
    expose(a, offset, sweep, instants(7), forth)
    spread(b, offset, sweep, instants(7), back)
    # Sums of 1e5 products of float32: relative to their norms some 1e-7 are lost.
    norms = np.linalg.norm(forth) * np.linalg.norm(b)
    assert abs(np.vdot(forth.astype(float), b) - np.vdot(a.astype(float), back)) < 1e-5 * norms


@pytest.mark.parametrize(
    "motion",
    [
        Motion(twist(0, 0, 0, 3, 6, 0), STILL),
        Motion(twist(0, 0, 0, -9, 12, 4), STILL),
        Motion(twist(6, -3, 2, 0, 0, 0), STILL),
        Motion(STILL, twist(0, 0, 0, 0, 8, 0)),
        Motion(twist(0, 0, 0, 1, 4, 0), twist(0, 0, 0, 2, 8, 0)),
    ],
    ids=["turn", "long turn with roll", "step", "rolling shutter", "both"],
)
def test_a_motion_is_found(truth: Image, depth: Image, motion: Motion) -> None:
    """By what it does to the image: turns and steps to the side are alike where the depth hardly varies."""
    observed = photograph(truth, motion, depth)
    luminance = np.array([0.2126, 0.7152, 0.0722], np.float32)
    weight = np.ones(depth.shape, np.float32)
    rendered, seen = (linear_from_srgb(image) @ luminance for image in (soft(truth), observed))
    found = fit_motion(rendered, seen, weight, CAMERA, depth)
    basis = flow_basis(CAMERA, depth)
    offset, sweep = (found - true for found, true in zip(found.ways(basis), motion.ways(basis), strict=True))
    assert np.hypot(*offset).mean() < 0.5
    # An exposure is the same from its end to its start. A soft render leaves part of a blur unseen.
    backwards = sweep + 2 * motion.ways(basis)[1]
    assert min(np.hypot(*sweep).mean(), np.hypot(*backwards).mean()) < 1.0


@pytest.mark.parametrize(
    "motion",
    [
        Motion(twist(0, 0, 0, 2, 5, 0), STILL),
        Motion(twist(0, 0, 0, -8, 9, 4), STILL),
        Motion(twist(0, 0, 0, 1, 3, 0), twist(0, 0, 0, 2, 6, 0)),
    ],
)
def test_undoing_it_is_worth_more_than_frame_or_render(truth: Image, depth: Image, motion: Motion) -> None:
    observed, render = photograph(truth, motion, depth), soft(truth)
    result = deblur(render, observed, None, CAMERA, depth)
    # Measured with the true motion: 1.2 to 3.6 dB above the better one; with the motion found 0.35 to 1.6.
    assert psnr(result.image, truth) > max(psnr(observed, truth), psnr(render, truth)) + 0.2
    basis = flow_basis(CAMERA, depth)
    blur, skew = (np.hypot(*np.tensordot(part, basis, 1)).mean() for part in (motion.blur, motion.skew))
    # A soft render leaves part of a blur unseen, of a short one the larger part; a skew is found to 0.2 px.
    assert result.blur_px == pytest.approx(blur, abs=2.0)
    assert result.skew_px == pytest.approx(skew, abs=0.3)


def test_a_sharp_render_explains_a_blurred_frame(truth: Image, depth: Image) -> None:
    motion = Motion(twist(0, 0, 0, 2, 9, 0), twist(0, 0, 0, 1, 6, 0))
    observed = photograph(truth, motion, depth)
    mask = np.ones(depth.shape, np.bool_)
    mask[:, :40] = False
    observed[~mask] = 1.0
    photographed = as_photographed(truth, observed, mask, CAMERA, depth)
    seen = np.s_[:, 60:]
    # Measured: 18 dB as it is, 36 dB with the motion.
    assert psnr(truth[seen], observed[seen]) < 22.0
    assert psnr(photographed[seen], observed[seen]) > 32.0


def test_a_sharp_frame_stays_nearly_as_it_is(truth: Image, depth: Image) -> None:
    observed = photograph(truth, Motion(STILL, STILL), depth, noise=0.0)
    result = deblur(soft(truth), observed, None, CAMERA, depth)
    assert result.blur_px < 1.0
    assert psnr(result.image, truth) > psnr(soft(truth), truth) + 6.0


def test_masked_pixels_come_from_the_render(truth: Image, depth: Image) -> None:
    motion = Motion(twist(0, 0, 0, 2, 5, 0), STILL)
    observed, render = photograph(truth, motion, depth), soft(truth)
    mask = np.ones(depth.shape, np.bool_)
    mask[40:90, 60:120] = False
    ruined = observed.copy()
    ruined[~mask] = 1.0
    clean, spoilt = (deblur(render, image, mask, CAMERA, depth).image for image in (observed, ruined))
    np.testing.assert_array_equal(clean, spoilt)
    inner = np.s_[55:75, 75:105]  # farther from the border of the mask than the motion reaches
    np.testing.assert_allclose(spoilt[inner], render[inner], atol=0.01)


def test_what_moved_by_itself_spoils_only_its_place(truth: Image, depth: Image) -> None:
    motion = Motion(twist(0, 0, 0, 2, 5, 0), STILL)
    observed, render = photograph(truth, motion, depth), soft(truth)
    visited = observed.copy()
    visited[60:100, 90:140] = [0.9, 0.1, 0.1]
    clean, spoilt = (deblur(render, image, None, CAMERA, depth).image for image in (observed, visited))
    away = np.ones(depth.shape, np.bool_)
    away[45:115, 75:155] = False
    assert np.abs(clean - spoilt)[away].mean() < 0.004


def test_nothing_to_see_changes_nothing(depth: Image) -> None:
    flat = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    result = deblur(flat, flat, None, CAMERA, depth)
    np.testing.assert_allclose(result.image, flat, atol=1e-5)
    black = np.zeros_like(flat)
    assert np.isfinite(deblur(black, flat, None, CAMERA, depth).image).all()
    assert np.isfinite(deblur(flat, black, np.zeros(depth.shape, np.bool_), CAMERA, depth).image).all()


@pytest.mark.parametrize("size", [(2, 3), (9, 7), (700, 33)])
def test_any_size(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).random((*size, 3)).astype(np.float32)
    camera = replace(CAMERA, width=size[1], height=size[0])
    result = deblur(image, image, None, camera, np.ones(size, np.float32))
    assert result.image.shape == image.shape
    assert np.isfinite(result.image).all()


def test_threads_do_not_change_a_bit(truth: Image, depth: Image) -> None:
    motion = Motion(twist(0, 0, 0, 2, 5, 1), twist(0, 0, 0, 0, 3, 0))
    observed, images = photograph(truth, motion, depth), []
    for threads in (1, 2):
        set_threads(threads)
        images.append(deblur(soft(truth), observed, None, CAMERA, depth).image)
    np.testing.assert_array_equal(*images)


def test_more_steps_than_the_solver_takes_change_little(
    truth: Image, depth: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    motion = Motion(twist(0, 0, 0, 3, 9, 0), STILL)
    observed, basis = photograph(truth, motion, depth), flow_basis(CAMERA, depth)
    weight = np.ones(depth.shape, np.float32)
    usual = undo_motion(soft(truth), observed, weight, motion, basis)
    monkeypatch.setattr("cleargs.rivr.motion.undo.STEPS", 60)
    solved = undo_motion(soft(truth), observed, weight, motion, basis)
    assert np.abs(usual - solved).mean() < 1 / 255
