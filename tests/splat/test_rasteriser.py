"""The kernels against the float64 oracle: image, alpha, depth and all gradients.

Scenes for both back ends are small, since Triton's interpreter takes milliseconds per (tile, splat) pair.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.splat_scenes import (
    BACKGROUND,
    GRADIENT_TOLERANCE,
    IMAGE_TOLERANCE,
    assert_close,
    compare,
    leaves,
    make_camera,
    make_gaussians,
)

from cleargs.errors import InputError, StageError
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu.simd import LANES
from cleargs.splat.render import render


@pytest.mark.skipif(LANES == 8, reason="the other tests use eight lanes here")
def test_vectors_of_eight_lanes_equal_oracle_too():
    program = (
        "import json; from helpers.splat_scenes import compare, make_camera, make_gaussians;"
        "camera = make_camera();"
        "from cleargs.splat.kernels.cpu.simd import LANES;"
        "result = compare(make_gaussians(camera, 60, size_px=5.0), camera);"
        "print(json.dumps([LANES, result.image, max(result.gradients.values())]))"
    )
    environment = os.environ | {
        "NUMBA_CPU_NAME": "x86-64-v3",
        "NUMBA_CPU_FEATURES": "+avx2,+fma",
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    lanes, image, gradient = json.loads(result.stdout)
    assert lanes == 8
    assert image < IMAGE_TOLERANCE
    assert gradient < GRADIENT_TOLERANCE


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_degree_limits_colour_and_gradient(degree):
    camera = make_camera()
    gaussians = make_gaussians(camera, 40)
    assert_close(compare(gaussians, camera, sh_degree=degree))
    live = leaves(gaussians, torch.float32)
    render(live, camera, sh_degree=degree).image.sum().backward()
    used = (degree + 1) ** 2
    assert (live.sh.grad[:, :used] != 0).any()
    assert not live.sh.grad[:, used:].any()


@pytest.mark.parametrize("focal", [50.0, 50_000.0])
def test_extreme_focal_lengths(focal):
    camera = make_camera(focal=focal)
    # Pixel positions are focal * x / z: exact float32 parameters, projected in float64.
    assert_close(compare(make_gaussians(camera, 60), camera))


def test_splat_covering_the_image():
    camera = make_camera()
    gaussians = make_gaussians(camera, 20)
    gaussians.log_scales[3] = 3.0
    assert_close(compare(gaussians, camera))


def test_huge_and_tiny_scales():
    camera = make_camera()
    gaussians = make_gaussians(camera, 40)
    gaussians.log_scales[0] = 30.0
    gaussians.log_scales[1] = -30.0
    gaussians.log_scales[2] = torch.tensor([10.0, -10.0, 0.0])
    # An aspect of 5e8 costs the float64 oracle itself eight digits, because its terms cancel.
    assert_close(compare(gaussians, camera), gradient=1e-4)


def test_zero_and_unnormalised_quaternions():
    camera = make_camera()
    gaussians = make_gaussians(camera, 40)
    gaussians.rotations[0] = 0.0
    gaussians.rotations[1] = torch.tensor([1e-20, 0.0, 0.0, 0.0])
    gaussians.rotations[2] *= 1e6
    gaussians.rotations[3] *= 1e-6
    live = leaves(gaussians, torch.float32)
    render(live, camera).image.sum().backward()
    assert not live.rotations.grad[0].any()  # the identity, at which R is stationary
    assert live.rotations.grad.isfinite().all()
    gaussians.rotations[3] *= 1e6  # its gradient, 1e6 times the others', would hide them
    assert_close(compare(gaussians, camera))


def test_too_many_pairs_is_an_error_before_allocation():
    camera = make_camera(20_000, 20_000)
    gaussians = make_gaussians(camera, 2000)
    gaussians.log_scales[:] = 6.0
    with pytest.raises(StageError, match="pairs"):
        rasteriser_for().forward(gaussians, camera)


def test_gradients_of_two_views_do_not_disturb_each_other():
    camera, other = make_camera(), make_camera(40, 30)
    gaussians = leaves(make_gaussians(camera, 40), torch.float32)
    first, second = render(gaussians, camera), render(gaussians, other)
    (first.image.sum() + second.image.sum()).backward()
    together = gaussians.means.grad.clone()
    gaussians.means.grad = None
    render(gaussians, camera).image.sum().backward()
    render(gaussians, other).image.sum().backward()
    torch.testing.assert_close(gaussians.means.grad, together, rtol=1e-6, atol=1e-6)


def test_backward_twice_through_one_render():
    camera = make_camera()
    gaussians = leaves(make_gaussians(camera, 40), torch.float32)
    result = render(gaussians, camera)
    (first,) = torch.autograd.grad(result.image[..., 0].sum(), gaussians.means, retain_graph=True)
    kept = first.clone()
    torch.autograd.grad(result.depth.sum(), gaussians.means)
    assert torch.equal(first, kept)


def test_engine_agrees_with_render_and_reuses_its_buffers():
    camera = make_camera()
    gaussians = make_gaussians(camera, 60)
    engine = rasteriser_for()
    first = engine.forward(gaussians, camera, background=BACKGROUND)
    address = first.image.data_ptr()
    assert first.depth is None
    assert torch.equal(first.image, render(gaussians, camera, background=BACKGROUND).image)
    smaller = gaussians.select(torch.arange(20))
    again = engine.forward(smaller, camera, background=BACKGROUND, depth=True)
    assert again.image.data_ptr() == address
    expected = render(smaller, camera, background=BACKGROUND)
    assert torch.equal(again.image, expected.image)
    assert torch.equal(again.depth, expected.depth)


def test_one_splat_by_hand():
    """At a splat's centre alpha is its opacity, the depth alpha z, and the colour is over the background."""
    camera = Camera(9, 9, 20.0, 20.0, 4.5, 4.5, np.eye(4))
    gaussians = Gaussians(
        torch.tensor([[0.0, 0.0, 2.0]]),
        torch.full((1, 3), float(np.log(0.1))),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        torch.zeros(1),
        torch.full((1, 1, 3), 0.3 / 0.28209479177387814),
    )
    result = render(gaussians, camera, background=BACKGROUND)
    assert result.alpha[4, 4] == pytest.approx(0.5, abs=1e-6)
    assert result.depth[4, 4] == pytest.approx(1.0, abs=2e-6)
    assert result.image[4, 4].tolist() == pytest.approx([0.5 * 0.8 + 0.5 * b for b in BACKGROUND], abs=1e-6)
    # One pixel to the right; the variance is (20 * 0.1 / 2)² + 0.3 px².
    assert result.alpha[4, 5] == pytest.approx(0.5 * np.exp(-0.5 / 1.3), abs=1e-6)


def test_errors():
    camera = make_camera()
    gaussians = make_gaussians(camera, 3, sh_count=4)
    with pytest.raises(InputError, match="SH degree 2"):
        render(gaussians, camera, sh_degree=2)
    with pytest.raises(InputError, match="meta"):
        render(gaussians.to("meta"), camera)
    with pytest.raises(InputError, match="float32"):
        rasteriser_for().forward(leaves(gaussians, torch.float64), camera)
    with pytest.raises(InputError, match="rotations"):
        Gaussians(**{**gaussians.tensors(), "rotations": torch.zeros(3, 3)})
    with pytest.raises(InputError, match="coefficients"):
        Gaussians(**{**gaussians.tensors(), "sh": torch.zeros(3, 5, 3)})


@pytest.mark.parametrize(
    ("n", "opacity", "size_px", "antialias"),
    [
        (16, (0.05, 0.95), 3.0, False),
        (16, (0.05, 0.95), 3.0, True),
        (16, (0.9, 0.9999), 3.0, False),
        (40, (0.05, 0.9), 0.3, True),
    ],
    ids=["ordinary", "antialias", "opaque", "sub-pixel"],
)
def test_random_scene_equals_oracle(n, opacity, size_px, antialias, device):
    camera = make_camera(20, 18)
    result = compare(
        make_gaussians(camera, n, opacity=opacity, size_px=size_px),
        camera,
        antialias=antialias,
        device=device,
    )
    assert_close(result)
    assert result.alpha.max() > 0.2
    assert result.alpha.min() < 0.99
    assert all(size > 1e-3 for size in result.gradient_sizes.values())


@pytest.mark.parametrize("size", [(1, 1), (1, 37), (35, 1), (16, 16), (17, 33)])
def test_any_image_size(size, device):
    camera = make_camera(*size, focal=40.0)
    result = compare(make_gaussians(camera, 20), camera, device=device)
    assert_close(result)
    assert result.alpha.max() > 0.1


def test_behind_and_across_the_near_plane(device):
    camera = make_camera(30, 24)
    gaussians = make_gaussians(camera, 25)
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    depths = np.array([-3.0, -0.01, 0.0, 0.009, 0.011, 0.05, 0.3])
    local = np.stack([0.1 * depths, -0.2 * depths, depths], -1)
    gaussians.means[: len(depths)] = torch.tensor((local - translation) @ rotation)
    # Splats at a depth of 0.011 hide most of the image.
    assert_close(compare(gaussians, camera, device=device), image=1e-5, gradient=3e-5)
    engine = rasteriser_for(device)
    engine.forward(gaussians.to(device), camera)
    assert engine.visible[:7].tolist() == [False, False, False, False, True, True, True]
    assert not engine.visible[:4].any()


@pytest.mark.parametrize("antialias", [False, True])
def test_needles(antialias, device):
    camera = make_camera(20, 18)
    gaussians = make_gaussians(camera, 12)
    gaussians.log_scales[:] = torch.tensor([1.5, 1.5 - np.log(1e4), 1.5 - np.log(1e4)], dtype=torch.float32)
    assert_close(
        compare(gaussians, camera, antialias=antialias, device=device), image=2e-5, gradient=5e-5
    )  # as on the CPU


def test_opacity_zero_and_one(device):
    camera = make_camera(20, 18)
    gaussians = make_gaussians(camera, 20)
    gaussians.logit_opacities[:6] = 50.0  # exactly 1: clamped to 0.999 at the centre
    gaussians.logit_opacities[6:12] = -50.0
    assert_close(compare(gaussians, camera, device=device))
    gaussians.logit_opacities[12] = float("-inf")
    gaussians.logit_opacities[13] = float("inf")
    engine = rasteriser_for(device)
    image = engine.forward(gaussians.to(device), camera).image
    gradients = engine.backward(torch.ones_like(image))
    assert all(tensor.isfinite().all() for tensor in gradients.tensors().values())
    assert not gradients.logit_opacities[6:13].any()


@pytest.mark.parametrize("n", [0, 5])
def test_nothing_visible(n, device):
    camera = make_camera(20, 18)
    gaussians = make_gaussians(camera, n)
    gaussians.means[:] = -gaussians.means - 20.0
    engine = rasteriser_for(device)
    result = engine.forward(gaussians.to(device), camera, background=BACKGROUND, depth=True)
    expected = torch.tensor(BACKGROUND, device=device).expand(18, 20, 3)
    torch.testing.assert_close(result.image, expected, rtol=0, atol=0)
    assert result.depth is not None
    assert not result.alpha.any()
    assert not result.depth.any()
    gradients = engine.backward(torch.ones_like(result.image))
    assert gradients.num == n
    assert all(not tensor.any() for tensor in gradients.tensors().values())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means", float("nan")),
        ("log_scales", float("inf")),
        ("rotations", float("nan")),
        ("sh", float("inf")),
    ],
)
def test_a_splat_that_is_not_finite_is_culled(name, value, device):
    camera = make_camera(20, 18)
    gaussians = make_gaussians(camera, 8)
    others = gaussians.select(torch.arange(8) != 3).to(device)
    getattr(gaussians, name)[3] = value
    engine = rasteriser_for(device)
    image = engine.forward(gaussians.to(device), camera).image.clone()
    gradients = engine.backward(torch.ones_like(image))
    assert not engine.visible[3]
    assert all(tensor.isfinite().all() for tensor in gradients.tensors().values())
    assert torch.equal(image, render(others, camera).image)


def test_several_chunks_per_tile_and_the_stop(device):
    """150 splats on one tile are three chunks. Some pixels stop in the first, others never."""
    camera = make_camera(16, 14, focal=20.0)
    gaussians = make_gaussians(camera, 150, opacity=(0.3, 0.999), size_px=1.0)
    result = compare(gaussians, camera, device=device)
    assert_close(result)
    assert (result.alpha > 1 - 1.5e-4).any()
    assert (result.alpha < 0.99).any()


@pytest.mark.parametrize(("stored", "degree"), [(16, 0), (16, 2), (9, None), (4, None), (1, None)])
def test_sh_degrees(stored, degree, device):
    camera = make_camera(20, 18)
    assert_close(
        compare(make_gaussians(camera, 12, sh_count=stored), camera, sh_degree=degree, device=device)
    )


def test_splats_at_one_depth_are_ordered_by_index(device):
    camera = Camera(16, 16, 15.0, 15.0, 8.0, 8.0, np.eye(4))
    gaussians = make_gaussians(camera, 60, opacity=(0.05, 0.5), size_px=3.0)
    gaussians.means[:, 2] = 4.0
    assert_close(compare(gaussians, camera, device=device))
    backwards = gaussians.select(torch.arange(59, -1, -1)).to(device)
    assert not torch.allclose(
        render(gaussians.to(device), camera).image, render(backwards, camera).image, atol=1e-3
    )


def test_two_runs_give_the_same_bits_and_reuse_buffers(device):
    camera = make_camera(20, 18)
    gaussians = make_gaussians(camera, 12).to(device)
    engine = rasteriser_for(device)
    outcomes = []
    for _ in range(2):
        image = engine.forward(gaussians, camera).image
        memory, first = image.data_ptr(), image.clone()
        gradients = engine.backward(torch.sin(first)).clone()
        engine.forward(gaussians.select(torch.arange(4, device=device)), make_camera(16, 9))
        outcomes.append((memory, first, *gradients.tensors().values()))
    (memory, *first), (again, *second) = outcomes
    assert memory == again
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
