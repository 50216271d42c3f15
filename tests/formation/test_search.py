"""The search finds how the camera moved during a frame."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from helpers.observations import (
    CAMERA,
    HEIGHT,
    MEDIAN,
    WIDTH,
    Image,
    frame_pair,
    observe,
    picture,
    soft,
    twist,
    wall,
    wall_fields,
)
from scipy.ndimage import map_coordinates

from cleargs.formation import comparison
from cleargs.formation.comparison import FramePair
from cleargs.formation.motion import TWIST, FrameMotion, Model, flow_basis
from cleargs.formation.pretest import missing_blur
from cleargs.formation.search import blur_along, preferred, refine, search
from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.splat.backend import set_threads
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.cpu import backend as cpu
from cleargs.splat.kernels.cpu import frame_search as kernels
from cleargs.types import ArrayF32, ArrayF64

BLUR = FrameMotion(blur=twist(0, 0, 0, 3, 6, 0), median_depth=MEDIAN)
LONG = FrameMotion(blur=twist(0, 0, 0, -9, 12, 4), median_depth=MEDIAN)
STEP = FrameMotion(blur=twist(6, -3, 2, 0, 0, 0), median_depth=MEDIAN)
SKEW = FrameMotion(skew=twist(0, 0, 0, 0, 8, 0), median_depth=MEDIAN)
BOTH = FrameMotion(blur=twist(0, 0, 0, 1, 4, 0), skew=twist(0, 0, 0, 2, 8, 0), median_depth=MEDIAN)
ARC = FrameMotion(blur=twist(0, 0, 0, 3, 9, 0), bend=twist(0, 0, 0, 12, -5, 0), median_depth=MEDIAN)
SHAKE = FrameMotion(blur=twist(0, 0, 0, 3, 9, 0), cube=twist(0, 0, 0, 40, 0, 0), median_depth=MEDIAN)
FOCUS = FrameMotion(disc_px=9.0, focus=1.6, median_depth=MEDIAN)


@pytest.fixture(scope="module")
def truth() -> Image:
    return picture()


def test_a_pair_and_its_level_do_not_keep_each_other_in_memory() -> None:
    """Each has images of the whole frame: trainings took half a gigabyte more until the collector ran."""
    grey = np.random.default_rng(0).random((48, 64)).astype(np.float32)
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))
    pair = FramePair(grey, grey, grey, grey, np.ones_like(grey), camera, 0)
    level = weakref.ref(pair.finest)
    gc.disable()
    try:
        assert level() is pair.finest
        del pair
        assert level() is None
    finally:
        gc.enable()


def test_the_flow_is_that_of_a_small_camera_motion() -> None:
    """Points of the image carried by a twist of a tenth of a pixel's size land where the basis says."""
    depth = wall()
    basis = flow_basis(CAMERA, MEDIAN / depth)
    y, x = np.indices(depth.shape) + 0.5
    rays = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones_like(x)], -1)
    points = rays * depth[..., None]
    for component in range(TWIST):
        small = np.zeros(TWIST)
        small[component] = 0.1 / CAMERA.fx
        moved = points - small[:3] * MEDIAN - np.cross(small[3:], points)
        u = CAMERA.fx * moved[..., 0] / moved[..., 2] + CAMERA.cx
        v = CAMERA.fy * moved[..., 1] / moved[..., 2] + CAMERA.cy
        # The error of a linear flow of a tenth of a pixel is of the second order: 1e-4 px here.
        np.testing.assert_allclose(0.1 * basis[component], np.stack([u - x, v - y]), atol=3e-4)


def test_the_flow_of_a_reduced_view_is_reduced() -> None:
    depth = wall()
    small = cv2.resize(depth, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
    full, half = flow_basis(CAMERA, MEDIAN / depth), flow_basis(CAMERA, MEDIAN / small)
    averaged = full.reshape(TWIST, 2, HEIGHT // 2, 2, WIDTH // 2, 2).mean((3, 5))
    np.testing.assert_allclose(half, averaged / 2, atol=2e-3)  # the mean of 1 / depth is not 1 / mean depth


@pytest.mark.parametrize(
    ("motion", "model"),
    [
        (BLUR, "blur"),
        (LONG, "blur"),
        (STEP, "blur"),
        (ARC, "blur"),
        (SHAKE, "blur"),
        (SKEW, "skew"),
        (BOTH, "both"),
        (FOCUS, "defocus"),
    ],
    ids=["turn", "long turn with roll", "step", "arc", "shake", "rolling shutter", "both", "defocus"],
)
def test_what_happened_is_found(truth: Image, motion: FrameMotion, model: Model) -> None:
    """By its effect on the image: turns and sideways steps look alike if the depth varies little."""
    # A skew on top of an arc explains a little more than nothing.
    found = preferred(search(frame_pair(soft(truth), observe(truth, motion)), skew=motion.order == 1))
    assert found.model == model
    assert found.explained > 0.3
    assert found.motion.order >= motion.order and (motion.order > 1 or found.motion.order == 1)
    ours, theirs = (wall_fields(m) for m in (found.motion, motion))
    assert torch.hypot(*(ours.offset - theirs.offset)).mean() < 0.5
    # An exposure is the same from its end to its start. A soft render leaves part of a blur unseen.
    apart = [torch.hypot(*(ours.sweep - sign * theirs.sweep)).mean() for sign in (1, -1)]
    assert min(apart) < 1.0
    assert (ours.radius - theirs.radius).abs().mean() < 0.7


@pytest.mark.parametrize("angle", [0.0, 1.0])
def test_a_frame_that_shows_the_scene_twice_is_explained(truth: Image, angle: float) -> None:
    """The camera rests, jumps and rests again. No straight path explains that better than none does."""
    jump = twist(0, 0, 0, 10 * np.cos(angle), 10 * np.sin(angle), 0)
    between = FrameMotion(pose=jump / 2, blur=jump, median_depth=MEDIAN)
    path = {FrameMotion(): 0.7, between: 0.1, FrameMotion(pose=jump, median_depth=MEDIAN): 0.2}
    light = sum(share * linear_from_srgb(observe(truth, part, noise=0.0)) for part, share in path.items())
    grain = np.random.default_rng(0).standard_normal(truth.shape) / 255
    filmed = np.clip(srgb_from_linear(np.asarray(light)) + grain, 0, 1).astype(np.float32)
    pair = frame_pair(soft(truth), filmed)
    missing = missing_blur(pair.luminance, pair.observed, pair.weight)
    start = blur_along(missing.length, missing.angle)
    found = search(pair, start=start, skew=False, defocus=False, pose=True)
    straight = [fit for fit in found if fit.model == "blur" and fit.motion.order == 1]
    assert max(fit.explained for fit in straight) < 0.02
    assert preferred(found).explained > 0.15 and preferred(found).motion.order == 3


def test_a_sharp_frame_is_left_alone(truth: Image) -> None:
    found = preferred(search(frame_pair(soft(truth), observe(truth, FrameMotion()))))
    # A soft render next to a sharp frame: nothing that a camera does makes the render sharper.
    assert found.explained < 0.01


def test_a_fit_goes_on_from_the_last_one(truth: Image) -> None:
    nearly = replace(BLUR, blur=0.8 * BLUR.blur)
    still, found = refine(frame_pair(soft(truth), observe(truth, BLUR)), "blur", nearly)
    assert still.model == "none"
    before = np.linalg.norm(nearly.blur - BLUR.blur)
    assert np.linalg.norm(found.motion.blur - BLUR.blur) < 0.5 * before


def test_a_large_image_is_fitted_by_some_of_its_rows(truth: Image, monkeypatch: pytest.MonkeyPatch) -> None:
    """They count for all, and the pixels that decide between models stay the same."""
    sharp, filmed, nearly = soft(truth), observe(truth, BLUR), replace(BLUR, blur=0.8 * BLUR.blur)
    whole = frame_pair(sharp, filmed).finest
    monkeypatch.setattr(comparison, "FIT_PIXELS", HEIGHT * WIDTH // 3)
    thinned = frame_pair(sharp, filmed)
    assert thinned.finest.cost(nearly) != whole.cost(nearly)
    assert thinned.finest.cost(nearly) == pytest.approx(whole.cost(nearly), rel=0.1)
    assert thinned.finest.evaluate("blur", nearly).residual == whole.evaluate("blur", nearly).residual
    _, found = refine(thinned, "blur", nearly)
    before = np.linalg.norm(nearly.blur - BLUR.blur)
    assert np.linalg.norm(found.motion.blur - BLUR.blur) < 0.5 * before


def test_a_pose_is_corrected_with_the_motion(truth: Image) -> None:
    shifted = replace(BLUR, pose=twist(0, 0, 0, 1.0, -2.0, 0))
    observed = observe(truth, shifted)
    found = preferred(search(frame_pair(soft(truth), observed), pose=True))
    ours, theirs = (wall_fields(m) for m in (found.motion, shifted))
    assert torch.hypot(*theirs.offset).mean() > 2.0
    assert torch.hypot(*(ours.offset - theirs.offset)).mean() < 0.3


def test_masked_pixels_say_nothing(truth: Image) -> None:
    weight = np.ones((HEIGHT, WIDTH), np.float32)
    weight[40:90, 60:120] = 0.0
    observed = observe(truth, BLUR)
    ruined = np.where(weight[..., None] > 0, observed, np.float32(1.0))
    clean, spoilt = (preferred(search(frame_pair(soft(truth), o, weight))) for o in (observed, ruined))
    np.testing.assert_array_equal(clean.motion.vector, spoilt.motion.vector)


@pytest.mark.parametrize("size", [(2, 3), (9, 7), (700, 33)])
def test_any_size(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).random((*size, 3)).astype(np.float32)
    ones = np.ones(size, np.float32)
    camera = replace(CAMERA, width=size[1], height=size[0])
    frame = frame_pair(picture(), picture())
    seen = replace(
        frame,
        luminance=image[..., 0],
        depth=ones,
        alpha=ones,
        observed=image[..., 0],
        weight=ones,
        camera=camera,
    )
    assert all(np.isfinite(found.motion.vector).all() for found in search(seen))


def test_nothing_to_see_finds_nothing() -> None:
    flat = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    assert preferred(search(frame_pair(flat, flat))).explained <= 0.0
    nothing = np.zeros((HEIGHT, WIDTH), np.float32)
    assert preferred(search(frame_pair(flat, flat, nothing))).explained <= 0.0


def test_threads_do_not_change_a_bit(truth: Image) -> None:
    found = []
    for threads in (1, 2):
        set_threads(threads)
        found.append(preferred(search(frame_pair(soft(truth), observe(truth, BOTH)))))
    np.testing.assert_array_equal(found[0].motion.vector, found[1].motion.vector)
    assert found[0].residual == found[1].residual


@pytest.mark.parametrize("curved", [False, True], ids=["straight", "curved"])
def test_residuals_count_what_has_a_weight_and_nothing_else(curved: bool) -> None:
    """Against interpolation in float64; where a pixel has no weight, nothing that is not finite gets out."""
    rng = np.random.default_rng(4)
    height, width, limit = 9, 13, 0.3
    image, observed = rng.random((2, height, width)).astype(np.float32)
    weight = (rng.random((height, width)) * (rng.random((height, width)) > 0.4)).astype(np.float32)
    weight[3] = 0.0
    offset, sweep = (rng.standard_normal((2, 2, height, width)) * 3.0).astype(np.float32)
    radius = rng.random((height, width)).astype(np.float32)
    bent = (rng.standard_normal((4, height, width)) * 10.0 * curved).astype(np.float32)
    samples = rng.uniform(-0.5, 0.5, (5, 3)).astype(np.float32)
    unseen = weight == 0.0
    observed[unseen], radius[unseen] = np.nan, np.inf
    for field in (offset, sweep, bent):
        field[:, unseen] = np.nan
    rows = np.full(height, np.nan)
    curve = bent if curved else None
    kernels.residuals(image, observed, weight, offset, sweep, radius, curve, samples, limit, rows)

    expected = np.zeros(height)
    for y, x in zip(*np.nonzero(weight), strict=True):
        seen = []
        for time, u, v in samples.astype(np.float64):
            place = offset[:, y, x] + time * sweep[:, y, x] + np.array([u, v]) * radius[y, x]
            place += (time**2 - 1 / 12) * bent[:2, y, x] + (time**3 - 0.15 * time) * bent[2:, y, x]
            column, row = np.clip(x + place[0], 0, width - 1), np.clip(y + place[1], 0, height - 1)
            i, j = min(int(column), width - 2), min(int(row), height - 2)
            a, b = column - i, row - j
            above, below = ((1 - a) * image[k, i] + a * image[k, i + 1] for k in (j, j + 1))
            seen.append((1 - b) * above + b * below)
        expected[y] += weight[y, x] * min(abs(observed[y, x] - np.mean(seen)), limit)
    # float32 within: 1e-7 of a light of 1, a dozen pixels per row.
    np.testing.assert_allclose(rows, expected, atol=5e-6)


def test_the_equations_have_the_slopes_of_the_residual() -> None:
    """All 30 numbers of a curved motion, against finite differences of the squared difference."""
    y, x = np.indices((HEIGHT, WIDTH), np.float32)
    # Waves that are long against a pixel, so that slopes and interpolation of the images are good.
    seen = (0.5 + 0.2 * np.sin(x / 9.0) * np.cos(y / 12.0) + 0.1 * np.sin((x + 2 * y) / 14.0)).astype(
        np.float32
    )
    down = (np.arange(HEIGHT, dtype=np.float32) + 0.5) / HEIGHT - np.float32(0.5)
    basis = flow_basis(CAMERA, (MEDIAN / wall()).astype(np.float32))
    weight = np.zeros_like(seen)
    weight[30:-30, 30:-30] = 1.0
    observed = np.roll(seen, 3, axis=1)
    times = np.linspace(-0.5, 0.5, 13, dtype=np.float32)
    vector = np.concatenate([twist(1, 0, 0, 0, 1, 2), twist(0, 1, 0, 4, 6, 1), twist(1, 0, 0, 0, 2, 0)])
    vector = np.concatenate([vector, twist(0, 2, 0, 6, -8, 3), twist(15, 0, 3, 60, 75, 27)])

    def fields(numbers: ArrayF64) -> list[ArrayF32]:
        pose, blur, skew, bend, cube = np.einsum("kn,nchw->kchw", numbers.reshape(5, TWIST), basis)
        return [
            np.ascontiguousarray(field, np.float32)
            for field in (pose + skew * down[:, None], blur, np.concatenate([bend, cube]))
        ]

    def cost(numbers: ArrayF64) -> float:
        offset, sweep, curve = fields(numbers)
        total = np.zeros_like(seen)
        for t in times:
            place = offset + t * sweep + (t * t - 1 / 12) * curve[:2] + (t**3 - 0.15 * t) * curve[2:]
            total += map_coordinates(seen, (y + place[1], x + place[0]), order=1, mode="nearest")
        return 0.5 * float((weight * (observed - total / len(times)) ** 2).sum(dtype=np.float64))

    offset, sweep, curve = fields(vector)
    _, side = cpu.normal_equations(
        seen, seen, observed, weight, basis, down, offset, sweep, curve, times, 1e9, np.arange(30)
    )
    slopes = []
    for step in 0.25 * np.eye(30):
        slopes.append((cost(vector + step) - cost(vector - step)) / 0.5)
    scale = np.abs(slopes).reshape(5, TWIST).max(axis=1).repeat(TWIST)
    assert scale.min() > 1e-3
    # Linear interpolation flattens the slopes of waves of 60 px and more by less than a hundredth.
    assert (np.abs(side + slopes) / scale).max() < 0.03
