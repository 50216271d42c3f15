"""The operator B of a frame and its transpose: against float64, on hard cases, on any number of threads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch
from helpers.observations import CAMERA, MEDIAN, Image, twist, wall, wall_fields
from helpers.warp_oracle import (
    ALL,
    BENT,
    LONG,
    ROLLED,
    SCALE,
    SLIGHTLY_BENT,
    SMALL,
    constant_fields,
    dot,
    oracle,
    placed,
    random_image,
    scenery,
)
from scipy.spatial.transform import Rotation
from torch import Tensor

from cleargs.formation.motion import FrameMotion, pixel_paths
from cleargs.formation.warp import (
    Warp,
    displacement_fields,
    enough_samples,
    linear_curve,
    padded,
    samples,
    srgb_curve,
)
from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.splat.backend import backend_for, set_threads
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.warp_layout import CHANNELS, CURVE_LAST, MAX_NEARNESS, DisplacementFields

Doubles = npt.NDArray[np.float64]

CPU = torch.device("cpu")


MOTIONS = {
    "many samples": ALL,
    "one sample": ROLLED,
    "two passes": LONG,
    "curved": BENT,
    "curved, two passes": SLIGHTLY_BENT,
}


def test_a_blur_of_exactly_one_pixel_is_a_blur() -> None:
    plane = torch.zeros(16, 16)
    for length, blurred in ((0.0, False), (1.0, True)):
        sweep = torch.stack([torch.full_like(plane, length), plane])
        times, points = enough_samples(DisplacementFields(torch.zeros_like(sweep), sweep, plane))
        assert (times > 1, points) == (blurred, 1)


@pytest.mark.parametrize("margin", [0, 12])
@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_forward_and_transpose_equal_the_oracle(motion: FrameMotion, margin: int) -> None:
    wide = torch.from_numpy(np.pad(wall(), margin, mode="edge"))
    fields = displacement_fields(motion, CAMERA, wide, torch.ones_like(wide), margin)
    warp = Warp.of(fields, margin)
    assert (len(warp.samples) == 1) == (motion is ROLLED)
    assert (warp.between is not None) == (motion in (LONG, SLIGHTLY_BENT))
    assert (fields.curve is None) == (motion not in (BENT, SLIGHTLY_BENT))
    image = random_image(*wide.shape)
    expected = oracle(image[..., :3], warp)
    made = warp.forward(image)[..., :3]
    assert made.std() > 0.01
    # Positions of up to 240 px in float32 are good to 1.5e-5 px, and the image changes by up to 1 per pixel.
    np.testing.assert_allclose(made, expected.detach().numpy(), atol=5e-5)
    light = random_image(*fields.radius.shape)
    expected.backward(light[..., :3].double())
    back = warp.transpose(light)[..., :3]
    gradient = expected.image.grad.numpy()  # type: ignore[attr-defined]
    np.testing.assert_allclose(back, gradient, atol=2e-4)
    assert np.abs(gradient).max() > 0.5


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_transpose_is_the_transpose(motion: FrameMotion) -> None:
    rng = np.random.default_rng(0)
    fields = wall_fields(motion)
    warp = Warp.of(fields)
    a, b = (
        torch.from_numpy(padded(rng.standard_normal((*wall().shape, 3)).astype(np.float32))) for _ in range(2)
    )
    forth, back = warp.forward(a), warp.transpose(b)
    # Sums of 1e5 products of float32: relative to their norms some 1e-7 are lost.
    assert abs(dot(forth, b) - dot(a, back)) < 1e-5 * forth.norm() * b.norm()


def moved(motion: FrameMotion) -> tuple[DisplacementFields, int]:
    return displacement_fields(motion, SMALL, *scenery(4), 4, SCALE), 4


def aside(height: int, width: int) -> tuple[DisplacementFields, int]:
    """One sample between pixels, beyond all borders in places."""
    fields = constant_fields(height, width, 0.0, 0.0)
    fields.offset.copy_(torch.linspace(-3.3, 2.9, fields.offset.numel()).reshape(fields.offset.shape))
    return fields, 0


CASES = {
    "many samples": lambda: moved(ALL),
    "one sample": lambda: moved(ROLLED),
    "two passes": lambda: moved(LONG),
    "curved": lambda: moved(BENT),
    "curved, two passes": lambda: moved(SLIGHTLY_BENT),
    "longer than the image": lambda: (constant_fields(9, 14, 24.0, 0.0), 0),
    "higher than the image": lambda: (constant_fields(9, 14, 0.0, 24.0, 2.0), 0),
    "one pixel": lambda: (constant_fields(1, 1, 5.0, 5.0, 1.0), 0),
    "one row": lambda: (constant_fields(1, 9, 3.0, 2.0), 0),
    "one column": lambda: (constant_fields(40, 1, 0.0, 7.0, 3.0), 0),
    "one pixel, one sample": lambda: aside(1, 1),
    "one row, one sample": lambda: aside(1, 9),
    "two by two, one sample": lambda: aside(2, 2),
}


@pytest.mark.parametrize("case", CASES)
def test_hard_cases_equal_the_oracle(case: str, device: torch.device) -> None:
    fields, margin = CASES[case]()
    warp = Warp.of(fields, margin)
    assert (len(warp.samples) == 1) == ("one sample" in case)
    height, width = fields.radius.shape
    image, light = random_image(height + 2 * margin, width + 2 * margin), random_image(height, width) - 0.5
    light[..., 3] = 0.0  # padding
    there = Warp.of(placed(fields, device), margin)
    made, back = there.forward(image.to(device)).cpu(), there.transpose(light.to(device)).cpu()
    expected = oracle(image[..., :3], warp)
    expected.backward(light[..., :3].double())
    gradient = expected.image.grad
    # Positions of some 40 px in float32 are good to 4e-6 px, and the image changes by up to 1 per pixel; the
    # worst is 1.4e-6. Light piles up at the borders: errors relative to the most that is sent to a place.
    pile = max(1.0, float(gradient.abs().max()))
    assert (made[..., :3] - expected).abs().max() < 6e-6
    assert (back[..., :3] - gradient).abs().max() < 6e-6 * pile
    assert not back[..., 3].any()
    # The same shares both ways, so that only the sums are rounded: the worst is 5e-9 of the norms.
    assert abs(dot(made, light) - dot(image, back)) < 5e-8 * made.norm() * light.norm()


def test_a_flat_image_stays_flat_and_no_light_is_lost() -> None:
    fields = wall_fields(ALL)
    warp = Warp.of(fields)
    flat = torch.full((*wall().shape, 4), 0.25)
    np.testing.assert_allclose(warp.forward(flat)[..., :3], 0.25, atol=1e-6)
    light = random_image(*wall().shape)
    back = warp.transpose(light)
    torch.testing.assert_close(back.double().sum((0, 1)), light.double().sum((0, 1)), rtol=1e-5, atol=0.0)


def test_what_lies_between_pixels_stays_sharp() -> None:
    """Half a pixel aside, linear interpolation leaves 87 % of waves of six pixels, cubics leave 95 %."""
    waves = np.tile(np.cos(np.pi / 3 * np.arange(60)), (20, 1))
    image = torch.from_numpy(padded(np.repeat(waves[..., None], 3, axis=2).astype(np.float32)))
    fields = constant_fields(20, 60, 0.0, 0.0)
    fields.offset[0] = 0.5
    made = Warp.of(fields).forward(image)[:, 3:-3, 0].numpy()
    expected = np.cos(np.pi / 3 * (np.arange(60) + 0.5))[3:-3]
    assert np.abs(made - expected).max() < 0.06


def test_a_still_frame_is_the_image_itself(device: torch.device) -> None:
    warp = Warp.of(placed(constant_fields(9, 14, 0.0, 0.0), device))
    image = random_image(9, 14).to(device)
    assert torch.equal(warp.forward(image), image)
    # Shares of 2^-54 of the brightest pixel are lost, which is less than float32 keeps of any of these.
    assert torch.equal(warp.transpose(image), image)


@pytest.mark.parametrize("size", [0.0, 1e-15, 1e-6, 1e20])
def test_light_of_any_size_comes_back(size: float, device: torch.device) -> None:
    warp = Warp.of(placed(constant_fields(7, 8, 3.0, 1.0), device))
    light = random_image(7, 8).to(device)
    expected = size * warp.transpose(light)
    assert (warp.transpose(size * light) - expected).abs().max() <= 1e-6 * expected.max()


def test_depth_that_is_no_number_counts_as_the_median() -> None:
    depth = torch.from_numpy(wall())
    depth[10:20] = np.nan
    depth[30:40] = 0.0
    alpha = torch.ones_like(depth)
    alpha[50:60] = 0.0
    alpha[70:80] = np.nan
    fields = displacement_fields(ALL, CAMERA, depth, alpha)
    flat = displacement_fields(ALL, CAMERA, torch.full_like(depth, MEDIAN), torch.ones_like(depth))
    for rows in (slice(10, 20), slice(30, 40), slice(50, 60), slice(70, 80)):
        np.testing.assert_array_equal(fields.sweep[:, rows], flat.sweep[:, rows])
    assert all(field.isfinite().all() for field in fields[:3])


def test_a_depth_edge_moves_each_side_by_its_own_way() -> None:
    """A step to the side moves what is near further: a scene point's way is inverse to its depth."""
    depth = torch.full(wall().shape, 4.0)
    depth[:, :100] = 2.0
    motion = FrameMotion(blur=twist(6, 0, 0, 0, 0, 0), median_depth=4.0)
    fields = displacement_fields(motion, CAMERA, depth, torch.ones_like(depth))
    np.testing.assert_allclose(fields.sweep[0, :, :100], -12.0)
    np.testing.assert_allclose(fields.sweep[0, :, 100:], -6.0)


def test_a_long_skew_is_the_motion_of_a_slanted_wall() -> None:
    """Rows see the wall from exact poses. A displacement of first order is up to 0.38 px off."""
    motion = FrameMotion(skew=twist(9, -4, 3, 6, 14, 4), median_depth=MEDIAN)
    normal, distance = np.array([0.5, 0.3, 1.0]), MEDIAN
    row, column = np.indices((CAMERA.height, CAMERA.width)) + 0.5
    rays = np.stack([(column - CAMERA.cx) / CAMERA.fx, (row - CAMERA.cy) / CAMERA.fy, np.ones(row.shape)], -1)
    depth = torch.from_numpy((distance / (rays @ normal)).astype(np.float32))
    found = displacement_fields(motion, CAMERA, depth, torch.ones_like(depth)).offset.numpy()
    lengths = np.array([MEDIAN] * 3 + [1.0] * 3) / CAMERA.fx
    for line in range(9, CAMERA.height - 9, 9):
        moved = ((line + 0.5) / CAMERA.height - 0.5) * motion.skew * lengths
        turn = Rotation.from_rotvec(moved[3:]).as_matrix()
        # Centre and rays of the camera at this row, in the axes of the still one.
        origin, seen = -turn.T @ moved[:3], rays[line] @ turn
        points = origin + seen * ((distance - origin @ normal) / (seen @ normal))[:, None]
        places = points[:, :2] / points[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
        inside = ((places > 1) & (places < [CAMERA.width - 1, CAMERA.height - 1])).all(axis=1)
        exact = places - np.stack([column[line], row[line]], 1)
        off = np.linalg.norm(found[:, line].T - exact, axis=1)[inside]
        assert off.max() < 0.1, (line, off.max())


def test_floaters_do_not_move_by_whole_images() -> None:
    depth = torch.from_numpy(wall())
    depth[:10, :10] = 1e-4
    motion = FrameMotion(blur=twist(6, 0, 0, 0, 0, 0), median_depth=MEDIAN)
    fields = displacement_fields(motion, CAMERA, depth, torch.ones_like(depth))
    assert fields.sweep.abs().max() <= 6.0 * MAX_NEARNESS


def test_the_mean_of_views_along_the_path_is_what_one_warp_gives() -> None:
    """A turn about the vertical axis: the average of exactly rotated views, on an image of smooth waves."""
    angle, count = 8.0 / CAMERA.fx, 41

    def wave(x: Doubles, y: Doubles) -> Doubles:
        return 0.5 + 0.2 * np.sin(x / 6.0) * np.cos(y / 13.0)

    y, x = np.indices(wall().shape, float)
    mean = np.zeros_like(x)
    for t in (np.arange(count) + 0.5) / count - 0.5:
        ray = np.stack(
            [(x + 0.5 - CAMERA.cx) / CAMERA.fx, (y + 0.5 - CAMERA.cy) / CAMERA.fy, np.ones_like(x)]
        )
        s, c = np.sin(-angle * t), np.cos(angle * t)
        turned = np.stack([c * ray[0] + s * ray[2], ray[1], -s * ray[0] + c * ray[2]])
        at_x = turned[0] / turned[2] * CAMERA.fx + CAMERA.cx - 0.5
        at_y = turned[1] / turned[2] * CAMERA.fy + CAMERA.cy - 0.5
        mean += wave(at_x, at_y) / count
    motion = FrameMotion(blur=twist(0, 0, 0, 0, 8, 0), median_depth=MEDIAN)
    still = torch.from_numpy(padded(np.repeat(wave(x, y)[..., None], 3, 2).astype(np.float32)))
    made = Warp.of(wall_fields(motion)).forward(still)[..., 0].numpy()
    inner = np.s_[4:-4, 8:-8]  # a turn bends the rows near the corners
    assert np.abs(wave(x, y) - mean)[inner].max() > 0.02
    # Eight samples of a way of eight pixels, and bilinear interpolation of the waves.
    np.testing.assert_allclose(made[inner], mean[inner], atol=1.5e-3)


def test_two_passes_give_what_one_with_all_samples_gives() -> None:
    """A blur of 34 px before a step of depth, of 22 behind it."""
    depth = torch.full(wall().shape, 4.0)
    depth[:, :100] = 2.0
    motion = FrameMotion(blur=twist(12, 0, 0, 0, 10, 0), median_depth=4.0)
    fields = displacement_fields(motion, CAMERA, depth, torch.ones_like(depth))
    two, one = Warp.of(fields), Warp(fields, 0, torch.from_numpy(samples(64)))
    assert two.between is not None and len(two.samples) + len(two.between.samples) < 16
    y, x = np.indices(wall().shape, float)
    waves = 0.5 + 0.2 * np.sin(x / 6.0) * np.cos(y / 13.0)
    image = torch.from_numpy(padded(np.repeat(waves[..., None], 3, 2).astype(np.float32)))
    difference = (two.forward(image) - one.forward(image))[:, :, 0].abs().numpy()
    # The waves span 0.4; a sixth of the exposure is up to 6 px, and so far the step shows: 0.029. Elsewhere
    # 5e-4, at a border, where pixels outside the image are assumed to equal it.
    assert difference[:, 95:105].max() < 0.04
    assert max(difference[:, :95].max(), difference[:, 105:-4].max()) < 1e-3


@pytest.mark.parametrize("bend", [2.0, 6.0])
def test_two_passes_along_a_curve_give_what_one_with_all_samples_gives(bend: float) -> None:
    """A blur of 30 px that bends by a sixth of ``bend``; the parts differ from their mean by half a pixel."""
    motion = FrameMotion(
        blur=twist(0, 0, 0, 0, 30, 0),
        bend=twist(0, 0, 0, bend, 0, 0),
        cube=twist(0, 0, 0, 0, 6, 0),
        median_depth=MEDIAN,
    )
    fields = wall_fields(motion)
    two, one = Warp.of(fields), Warp(fields, 0, torch.from_numpy(samples(64)))
    assert two.between is not None and len(two.samples) + len(two.between.samples) < 20
    y, x = np.indices(wall().shape, float)
    waves = 0.5 + 0.2 * np.sin(x / 3.0) * np.cos(y / 2.0)
    image = torch.from_numpy(padded(np.repeat(waves[..., None], 3, 2).astype(np.float32)))
    straight = Warp(fields._replace(curve=None), 0, torch.from_numpy(samples(64)))
    inner = np.s_[4:-4, 20:-20, 0]
    error = (two.forward(image) - one.forward(image))[inner].abs().max()
    # The waves span 0.4, and what a straight path would give is 0.01 and 0.04 away.
    assert error < 0.004 < (straight.forward(image) - one.forward(image))[inner].abs().max()


def test_the_paths_of_pixels_are_those_of_the_fields() -> None:
    times = np.array([-0.5, -0.1, 0.3])
    motion = replace(BENT, pose=np.zeros(6))
    fields = displacement_fields(motion, CAMERA, torch.full(wall().shape, MEDIAN), torch.ones(wall().shape))
    assert fields.curve is not None
    shape = CAMERA.height, CAMERA.width
    found = pixel_paths(motion, CAMERA, shape, times)
    for t, displacement in zip(times, found, strict=True):
        curve = (t**2 - 1 / 12) * fields.curve[:2] + (t**3 - 0.15 * t) * fields.curve[2:]
        np.testing.assert_allclose(displacement, (t * fields.sweep + curve).permute(1, 2, 0), atol=1e-4)
    # A coarse grid has the paths of the pixels at its centres.
    coarse = pixel_paths(motion, CAMERA, (CAMERA.height // 5, CAMERA.width // 5), times)
    np.testing.assert_allclose(coarse, found[:, 2::5, 2::5], atol=1e-4)


def test_curves_are_srgb_and_their_slopes_are_exact() -> None:
    values = np.linspace(-0.1, 2.5, 9973).reshape(-1, 1, 1).repeat(3, 2).astype(np.float32)
    usual = (values > 0) & (values < CURVE_LAST)

    def followed(image: Image, curve: Tensor) -> tuple[Image, Image]:
        out, slope = backend_for(CPU).through_curve(torch.from_numpy(image), curve, 3)
        return out.numpy(), slope.numpy()

    for curve, formula, tolerance in (
        (linear_curve(CPU), linear_from_srgb, 1e-6),
        # Steepest where sRGB turns from straight to a power, at 0.003.
        (srgb_curve(CPU), srgb_from_linear, 3e-5),
    ):
        out, slope = followed(values, curve)
        expected = formula(values.astype(np.float64))
        np.testing.assert_allclose(out[usual], expected[usual], atol=tolerance)
        assert np.isfinite(out).all()
        step = np.float32(1e-3)
        (further, _), (before, _) = (followed(values + sign * step, curve) for sign in (1, -1))
        # Finite differences away from the formula's corner; the tables' pieces are 2.4e-4 wide.
        smooth = usual[..., 0].ravel() & (values[:, 0, 0] > 0.05) & (values[:, 0, 0] < 1.9)
        difference = (further - before)[smooth] / (2 * step)
        np.testing.assert_allclose(slope[smooth], difference, rtol=5e-3)


def test_the_whole_chain_has_the_gradient_that_finite_differences_show() -> None:
    fields, backend = wall_fields(ALL), backend_for(CPU)
    warp = Warp.of(fields)
    rng = np.random.default_rng(3)
    image = torch.from_numpy(rng.uniform(0.2, 0.8, (*wall().shape, 3)).astype(np.float32))
    weight, direction = (
        torch.from_numpy(rng.standard_normal(image.shape).astype(np.float32)) for _ in range(2)
    )

    def chain(picture: Tensor) -> tuple[float, Tensor]:
        linear, to_linear = backend.through_curve(picture, linear_curve(CPU), CHANNELS)
        photo, to_srgb = backend.through_curve(warp.forward(linear), srgb_curve(CPU), 3)
        back = backend.times_slope(weight, to_srgb, CHANNELS)
        return dot(photo, weight), backend.times_slope(warp.transpose(back), to_linear, 3)

    _, gradient = chain(image)
    step = 2e-3
    difference = (chain(image + step * direction)[0] - chain(image - step * direction)[0]) / (2 * step)
    assert dot(gradient, direction) == pytest.approx(difference, rel=2e-3)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_threads_do_not_change_a_bit(motion: FrameMotion) -> None:
    image = random_image(*wall().shape)
    results = []
    for threads in (1, 2):
        set_threads(threads)
        warp = Warp.of(wall_fields(motion))
        results.append((warp.forward(image), warp.transpose(image)))
    for first, second in zip(*results, strict=True):
        np.testing.assert_array_equal(first, second)


def test_samples_are_centred() -> None:
    for count in (1, 3, 16, 64):
        points = samples(count)
        assert points.shape == (count, 3)
        np.testing.assert_allclose(points[:, 0].mean(), 0.0, atol=1e-6)
        np.testing.assert_allclose(points[:, 1:].mean(axis=0), 0.0, atol=1e-6)
        assert np.hypot(points[:, 1], points[:, 2]).max() < 1.1
    # The mean square of a disc's points is half of its rim's.
    np.testing.assert_allclose((samples(64)[:, 1:] ** 2).sum(axis=1).mean(), 0.5, atol=0.02)


def test_a_camera_of_another_size_scales_the_motion() -> None:
    half = CAMERA.scaled(0.5)
    assert isinstance(half, Camera)
    full = wall_fields(ALL)
    small = torch.from_numpy(wall()[::2, ::2].copy())
    reduced = displacement_fields(ALL, half, small, torch.ones_like(small), scale=0.5)
    # A reduced pixel's centre lies half a pixel from the ones it is compared with.
    np.testing.assert_allclose(reduced.sweep, 0.5 * full.sweep[:, ::2, ::2], atol=0.06)
