"""Exposures are means over poses of the path itself, row by row, in either world."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.comparison.splat_world import SplatWorld, _camera
from cleargs.media.colour import linear_from_srgb
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.render import render
from cleargs.splat.scene import Scene
from cleargs.synth.image_motion import INSTANTS, ROW_STEP, SimulatedMotion, duration_for, follow
from cleargs.synth.optics import MIN_SAMPLES, Aperture, Lens, Shutter, World, disc, phone_lens, still
from cleargs.synth.path import HandheldPath, frame_times
from cleargs.synth.raycast import room_setting

WIDTH, HEIGHT = 96, 54
EXPOSURE, READOUT = 0.06, 0.05


@pytest.fixture(scope="module")
def motion() -> SimulatedMotion:
    """A fast frame of a walk."""
    setting = room_setting(16, WIDTH, HEIGHT, 0)
    path = HandheldPath(setting.course, 16, 0)
    frames = [
        follow(path, time, setting.world.depth(path.poses(np.array([time]))[0], setting.lens), setting.lens)
        for time in frame_times(16)
    ]
    return max(frames, key=lambda frame: frame.blur(EXPOSURE))


@pytest.fixture(scope="module", params=["room", "scene"])
def world(request: pytest.FixtureRequest, motion: SimulatedMotion) -> World:
    """The room, or 200 splats where the frame sees surfaces."""
    if request.param == "room":
        return room_setting(16, WIDTH, HEIGHT, 0).world
    generator = torch.Generator().manual_seed(0)
    means = torch.from_numpy(motion.points[:: max(1, len(motion.points) // 200)]).float()
    count = len(means)
    return SplatWorld(
        Scene(
            Gaussians(
                means=means,
                log_scales=torch.full((count, 3), -2.5),
                rotations=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
                logit_opacities=torch.full((count,), 3.0),
                sh=torch.randn(count, 1, 3, generator=generator),
            ),
            background=(0.2, 0.3, 0.4),
        )
    )


def test_the_shutter_samples_the_path_about_the_middle(motion: SimulatedMotion) -> None:
    shutter = motion.shutter(EXPOSURE, 0.0)
    assert shutter.samples >= max(MIN_SAMPLES, motion.blur(EXPOSURE))
    times = motion.time + EXPOSURE * ((np.arange(shutter.samples) + 0.5) / shutter.samples - 0.5)
    # The instants are multiples of a tick, added up in another order than here: rounding errors only.
    np.testing.assert_allclose(shutter.poses[shutter.index[:, 0]], motion.path.poses(times), atol=1e-12)
    assert (shutter.index == shutter.index[:, :1]).all()


def test_the_blur_length_is_that_of_the_tracked_points(motion: SimulatedMotion) -> None:
    times = motion.time + EXPOSURE * np.linspace(-0.5, 0.5, INSTANTS)
    total, lens = 0.0, motion.lens
    for point in motion.points:
        track = []
        for pose in motion.path.poses(times):
            x, y, z = pose[:, :3].T @ (point - pose[:, 3])
            track.append([lens.fx * x / z, lens.fy * y / z])
        total += np.linalg.norm(np.diff(track, axis=0), axis=1).sum() / len(motion.points)
    assert motion.blur(EXPOSURE) == pytest.approx(total)
    exposure = duration_for(2.5, motion.blur)
    assert motion.blur(exposure) == pytest.approx(2.5, abs=1e-3)


def test_an_exposure_is_the_mean_of_its_instants_in_linear_light(
    world: World, motion: SimulatedMotion
) -> None:
    shutter, lens = motion.shutter(EXPOSURE, 0.0), motion.lens
    image = world.render(shutter, lens)
    assert image.min() > 0 and 0.05 < image.mean() < 0.9
    if isinstance(world, SplatWorld):
        pictures = [
            render(world._scene.gaussians, _camera(pose, lens), background=world._scene.background).image
            for pose in shutter.poses
        ]
        mean = np.mean(
            [linear_from_srgb(np.clip(picture.numpy().astype(np.float64), 0, 1)) for picture in pictures], 0
        )
        np.testing.assert_allclose(image, mean, atol=1e-12)
    else:
        # Rays differ in their place inside the pixel: means of 8 rays an instant against one. The eighth
        # of the picture with the strongest edges may be off by more than the rest, the mean may not.
        mean = np.mean([world.render(still(pose, HEIGHT), lens) for pose in shutter.poses], 0)
        assert np.quantile(np.abs(image - mean), 0.875) < 0.03
        assert image.mean() == pytest.approx(mean.mean(), rel=2e-3)
    instant = world.render(still(shutter.poses[len(shutter.poses) // 2], HEIGHT), lens)
    assert np.abs(image - instant).mean() > 0.01


def test_every_row_is_that_of_a_global_shutter_at_its_pose(world: World, motion: SimulatedMotion) -> None:
    shutter, lens = motion.shutter(0.0, READOUT), motion.lens
    image = world.render(shutter, lens)
    for row in (0, HEIGHT // 3, HEIGHT - 1):
        pose = shutter.poses[shutter.index[0, row]]
        np.testing.assert_allclose(image[row], world.render(still(pose, HEIGHT), lens)[row], atol=1e-12)
    middle = world.render(still(motion.path.poses(np.array([motion.time]))[0], HEIGHT), lens)
    assert np.abs(image - middle)[[0, -1]].mean() > 0.01


def test_rows_see_their_own_pose_to_an_eighth_of_a_pixel(motion: SimulatedMotion) -> None:
    shutter = motion.shutter(0.0, READOUT)
    times = motion.time + READOUT * ((np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5)
    exact, used = motion.path.poses(times), shutter.poses[shutter.index[0]]
    turn = np.arccos(np.clip((np.einsum("rij,rij->r", exact[:, :, :3], used[:, :, :3]) - 1) / 2, -1, 1))
    # Turning moves the image by the focal length times the angle; the walk between shares little of it. The
    # speed within the readout varies by less than half.
    assert (turn * motion.lens.fx).max() < 1.5 * ROW_STEP / 2


def test_blur_and_rolling_shutter_together_integrate_each_row_about_its_time(motion: SimulatedMotion) -> None:
    shutter = motion.shutter(EXPOSURE, READOUT)
    blurred, rolling = motion.shutter(EXPOSURE, 0.0), motion.shutter(0.0, READOUT)
    assert shutter.samples == blurred.samples
    for row in (0, HEIGHT // 2, HEIGHT - 1):
        centres = shutter.poses[shutter.index[:, row], :, 3]
        # The mean over the row's own exposure is near the pose that the row has without blur.
        away = np.linalg.norm(centres.mean(0) - rolling.poses[rolling.index[0, row], :, 3])
        assert away < 0.1 * np.linalg.norm(np.ptp(shutter.poses[:, :, 3], axis=0))
    assert len(np.unique(shutter.index[:, 0])) == shutter.samples


def test_what_is_in_focus_stays_sharp_and_the_rest_blurs(world: World, motion: SimulatedMotion) -> None:
    lens: Lens = phone_lens(WIDTH, HEIGHT)
    pose = motion.path.poses(np.array([motion.time]))[0]
    depth = world.depth(pose, lens)
    focus = float(np.median(depth[depth > 0]))
    shutter = Shutter(pose[None], np.zeros((64, HEIGHT), np.intp))
    sharp = world.render(still(pose, HEIGHT), lens)
    wide = Aperture(disc(64, 0.05), focus)
    change = np.abs(world.render(shutter, lens, wide) - sharp).mean(2)
    # Disc radius in pixels: focal length times aperture times the difference in nearness. Parts that a
    # nearer thing borders on are left out by looking at medians.
    radius = lens.fx * 0.05 * np.abs(1 / focus - 1 / np.where(depth > 0, depth, focus))
    near_focus, off_focus = change[(radius < 0.15) & (depth > 0)], change[radius > 0.8]
    assert near_focus.size > 20 and off_focus.size > 20
    assert np.median(off_focus) > 1.5 * np.median(near_focus)
