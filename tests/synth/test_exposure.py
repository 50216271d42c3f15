"""Exposures are means over poses of the path, per row, in the room and in a splat scene."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.comparison.splat_world import SplatWorld, _camera
from cleargs.media.colour import linear_from_srgb
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.render import render
from cleargs.splat.scene import Scene
from cleargs.synth.image_motion import ROW_STEP, TRACK_POSES, SimulatedMotion, solve_duration, track_motion
from cleargs.synth.optics import (
    MIN_SAMPLES,
    Aperture,
    Lens,
    Shutter,
    World,
    disc,
    instant_shutter,
    phone_lens,
)
from cleargs.synth.path import HandheldPath, frame_times
from cleargs.synth.raycast import room_setup

WIDTH, HEIGHT = 96, 54
EXPOSURE, READOUT = 0.06, 0.05


@pytest.fixture(scope="module")
def motion() -> SimulatedMotion:
    """The fastest frame of a walk."""
    setup = room_setup(16, WIDTH, HEIGHT, 0)
    path = HandheldPath(setup.course, 16, 0)
    frames = [
        track_motion(path, time, setup.world.depth(path.poses(np.array([time]))[0], setup.lens), setup.lens)
        for time in frame_times(16)
    ]
    return max(frames, key=lambda frame: frame.blur(EXPOSURE))


@pytest.fixture(scope="module", params=["room", "scene"])
def world(request: pytest.FixtureRequest, motion: SimulatedMotion) -> World:
    """The room, or 200 splats on the surfaces that the frame sees."""
    if request.param == "room":
        return room_setup(16, WIDTH, HEIGHT, 0).world
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
    # The shutter computes its times as multiples of a step, so that there are rounding errors.
    np.testing.assert_allclose(shutter.poses[shutter.index[:, 0]], motion.path.poses(times), atol=1e-12)
    assert (shutter.index == shutter.index[:, :1]).all()


def test_the_blur_length_is_that_of_the_tracked_points(motion: SimulatedMotion) -> None:
    times = motion.time + EXPOSURE * np.linspace(-0.5, 0.5, TRACK_POSES)
    total, lens = 0.0, motion.lens
    for point in motion.points:
        track = []
        for pose in motion.path.poses(times):
            x, y, z = pose[:, :3].T @ (point - pose[:, 3])
            track.append([lens.fx * x / z, lens.fy * y / z])
        total += np.linalg.norm(np.diff(track, axis=0), axis=1).sum() / len(motion.points)
    assert motion.blur(EXPOSURE) == pytest.approx(total)
    exposure = solve_duration(2.5, motion.blur)
    assert motion.blur(exposure) == pytest.approx(2.5, abs=1e-3)


def test_an_exposure_is_the_mean_of_its_poses_in_linear_light(world: World, motion: SimulatedMotion) -> None:
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
        # Rays differ in their position inside the pixel: here are 8 rays per pose, in `image` one. The eighth
        # of the image with the strongest edges may differ by more than the rest, but the mean may not.
        mean = np.mean([world.render(instant_shutter(pose, HEIGHT), lens) for pose in shutter.poses], 0)
        assert np.quantile(np.abs(image - mean), 0.875) < 0.03
        assert image.mean() == pytest.approx(mean.mean(), rel=2e-3)
    instant = world.render(instant_shutter(shutter.poses[len(shutter.poses) // 2], HEIGHT), lens)
    assert np.abs(image - instant).mean() > 0.01


def test_each_row_equals_a_global_shutter_at_its_pose(world: World, motion: SimulatedMotion) -> None:
    shutter, lens = motion.shutter(0.0, READOUT), motion.lens
    image = world.render(shutter, lens)
    for row in (0, HEIGHT // 3, HEIGHT - 1):
        pose = shutter.poses[shutter.index[0, row]]
        np.testing.assert_allclose(
            image[row], world.render(instant_shutter(pose, HEIGHT), lens)[row], atol=1e-12
        )
    middle = world.render(instant_shutter(motion.path.poses(np.array([motion.time]))[0], HEIGHT), lens)
    assert np.abs(image - middle)[[0, -1]].mean() > 0.01


def test_poses_of_rows_are_exact_to_an_eighth_of_a_pixel(motion: SimulatedMotion) -> None:
    shutter = motion.shutter(0.0, READOUT)
    times = motion.time + READOUT * ((np.arange(HEIGHT) + 0.5) / HEIGHT - 0.5)
    exact, used = motion.path.poses(times), shutter.poses[shutter.index[0]]
    turn = np.arccos(np.clip((np.einsum("rij,rij->r", exact[:, :, :3], used[:, :, :3]) - 1) / 2, -1, 1))
    # Rotation moves the image by the focal length times the angle, and translation adds little. The speed
    # within the readout varies by less than half.
    assert (turn * motion.lens.fx).max() < 1.5 * ROW_STEP / 2


def test_blur_with_rolling_shutter_is_centred_on_each_row(motion: SimulatedMotion) -> None:
    shutter = motion.shutter(EXPOSURE, READOUT)
    blurred, rolling = motion.shutter(EXPOSURE, 0.0), motion.shutter(0.0, READOUT)
    assert shutter.samples == blurred.samples
    for row in (0, HEIGHT // 2, HEIGHT - 1):
        centres = shutter.poses[shutter.index[:, row], :, 3]
        # The mean over the row's exposure is near the row's pose without blur.
        away = np.linalg.norm(centres.mean(0) - rolling.poses[rolling.index[0, row], :, 3])
        assert away < 0.1 * np.linalg.norm(np.ptp(shutter.poses[:, :, 3], axis=0))
    assert len(np.unique(shutter.index[:, 0])) == shutter.samples


def test_surfaces_out_of_focus_are_blurred(world: World, motion: SimulatedMotion) -> None:
    lens: Lens = phone_lens(WIDTH, HEIGHT)
    pose = motion.path.poses(np.array([motion.time]))[0]
    depth = world.depth(pose, lens)
    focus = float(np.median(depth[depth > 0]))
    shutter = Shutter(pose[None], np.zeros((64, HEIGHT), np.intp))
    sharp = world.render(instant_shutter(pose, HEIGHT), lens)
    wide = Aperture(disc(64, 0.05), focus)
    change = np.abs(world.render(shutter, lens, wide) - sharp).mean(2)
    # The disc radius in pixels is focal length x aperture x difference of 1 / depth. Medians exclude parts
    # next to nearer objects.
    radius = lens.fx * 0.05 * np.abs(1 / focus - 1 / np.where(depth > 0, depth, focus))
    near_focus, off_focus = change[(radius < 0.15) & (depth > 0)], change[radius > 0.8]
    assert near_focus.size > 20 and off_focus.size > 20
    assert np.median(off_focus) > 1.5 * np.median(near_focus)
