"""A rolling shutter in the projection: against rows from exact poses, and its gradients."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from helpers.splat_scenes import make_camera, make_gaussians
from scipy.spatial.transform import Rotation
from torch import Tensor

from cleargs.formation.motion import FrameMotion, readout_of
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.rolling import own_poses

TWISTS = np.array([[0.5, -0.3, 0.2, 0.4, -0.2, 0.3], [5.0, -3, 2, 3, 5, 2], [0.6, 0.8, 0, 0.7, 0.4, 0]])
"""Pose, skew and its second order, px at a depth of 5. The skew has up to a ninth of the picture's height."""

CAMERA = make_camera(48, 36)
SMALL_SPLATS = make_gaussians(CAMERA, 60, size_px=1.5)


def rolling(camera: Camera, columns: bool = False) -> Camera:
    motion = FrameMotion(
        pose=TWISTS[0], skew=TWISTS[1], skew_bend=TWISTS[2], columns=columns, median_depth=5.0
    )
    return replace(camera, readout=readout_of(motion, camera))


def image(gaussians: Gaussians, camera: Camera, device: torch.device | str = "cpu") -> Tensor:
    return rasteriser_for(device).forward(gaussians.to(str(device)), camera).image.cpu().clone()


def from_exact_poses(gaussians: Gaussians, camera: Camera, columns: bool) -> Tensor:
    """Every row (or column) is that of a render from its own pose."""
    found = torch.empty(camera.height, camera.width, 3)
    pixels = camera.fx / np.array([5.0] * 3 + [1.0] * 3)
    count = camera.width if columns else camera.height
    for line in range(count):
        place = (line + 0.5) / count - 0.5
        twist = (TWISTS[0] + place * TWISTS[1] + place**2 * TWISTS[2]) / pixels
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = Rotation.from_rotvec(twist[3:]).as_matrix(), twist[:3]
        render = image(gaussians, replace(camera, world_to_camera=moved @ camera.world_to_camera))
        if columns:
            found[:, line] = render[:, line]
        else:
            found[line] = render[line]
    return found


@pytest.fixture(scope="module")
def exact() -> dict[bool, Tensor]:
    """Expected images of `SMALL_SPLATS`: with rows, and with columns, from exact poses.

    Pytest makes them before ``device``, so the kernels of the CPU draw them: the interpreter is slow.
    """
    return {columns: from_exact_poses(SMALL_SPLATS, CAMERA, columns) for columns in (False, True)}


def psnr(a: Tensor, b: Tensor) -> float:
    return float(-10.0 * torch.log10(((a - b) ** 2).mean()))


@pytest.mark.parametrize("columns", [False, True])
def test_rows_are_seen_from_their_own_poses(
    columns: bool, exact: dict[bool, Tensor], device: torch.device
) -> None:
    """Observed: 44 and 43 dB. A splat is sheared evenly, so larger ones differ more (3 px: 40 and 34 dB)."""
    assert psnr(image(SMALL_SPLATS, CAMERA, device), exact[columns]) < 20.0
    assert psnr(image(SMALL_SPLATS, rolling(CAMERA, columns), device), exact[columns]) > 42.0


def test_gradients_are_those_of_finite_differences(device: torch.device) -> None:
    camera = make_camera(32, 24)
    gaussians = make_gaussians(camera, 25, size_px=3.0, sh_count=1)
    noise = np.random.default_rng(1).normal(size=(24, 32, 3)).astype(np.float32)
    weights = torch.from_numpy(cv2.GaussianBlur(noise, (0, 0), 2.0))
    engine, seen = rasteriser_for(device), rolling(camera)
    engine.forward(gaussians.to(str(device)), seen)
    found = {k: v.cpu().clone() for k, v in engine.backward(weights.to(device)).tensors().items()}

    def value(name: str, change: Tensor) -> float:
        moved = replace(gaussians, **{name: gaussians.tensors()[name] + change})
        return float((image(moved, seen, device).double() * weights).sum())

    for name in ("means", "log_scales", "rotations"):
        along = found[name] / found[name].norm()
        step = 8e-3 * along  # long, since the edges of splats (alpha 1/255) are steps
        slope = (value(name, step) - value(name, -step)) / 16e-3
        # Observed: 3.4 % for the means, as the change of the shear with the position is left out.
        assert slope == pytest.approx(float(found[name].norm()), rel=0.05), name


def test_many_small_splats_are_those_of_exact_rows() -> None:
    """Observed: 53 dB (rows) and 55 dB (columns); 16 dB with a still camera."""
    camera = make_camera(240, 136)
    gaussians = make_gaussians(camera, 4000, size_px=1.5)
    for columns in (False, True):
        expected = from_exact_poses(gaussians, camera, columns)
        assert psnr(image(gaussians, rolling(camera, columns)), expected) > 50.0


def test_the_kernel_has_the_poses_of_the_tensors() -> None:
    means = make_gaussians(make_camera(), 300).means
    for columns in (False, True):
        camera = rolling(make_camera(), columns)
        found = rasteriser_for("cpu")._own_poses(means, camera)
        torch.testing.assert_close(found, own_poses(means, camera), rtol=1e-9, atol=1e-9)


def test_a_shutter_that_hardly_rolls_gives_the_picture_of_a_still_camera() -> None:
    camera = make_camera()
    gaussians = make_gaussians(camera, 60)
    none = replace(camera, readout=readout_of(FrameMotion(skew=1e-12 * TWISTS[1]), camera))
    assert psnr(image(gaussians, none), image(gaussians, camera)) > 120.0


def test_points_behind_and_at_the_camera_are_harmless(device: torch.device) -> None:
    camera = make_camera(30, 24)
    gaussians = make_gaussians(camera, 25)
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    depths = np.array([-3.0, -0.01, 0.0, 1e-9, 0.009, 0.011, 0.05])
    local = np.stack([0.1 * depths, -0.2 * depths, depths], -1)
    gaussians.means[: len(depths)] = torch.tensor((local - translation) @ rotation)
    gaussians.means[7] = float("nan")
    engine = rasteriser_for(device)
    render = engine.forward(gaussians.to(str(device)), rolling(camera))
    assert render.image.isfinite().all() and not engine.visible[7]
    gradients = engine.backward(torch.ones_like(render.image))
    assert all(value.isfinite().all() for value in gradients.tensors().values())
