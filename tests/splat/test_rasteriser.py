"""The CPU kernels against the float64 oracle: image, alpha, depth and all gradients."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from splat_scenes import BACKGROUND, compare, leaves, make_camera, make_gaussians

from cleargs.errors import InputError, StageError
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu.simd import LANES
from cleargs.splat.render import render

# float32 resolves 6e-8; blending some tens of splats and 2^x by a polynomial (relative error 1e-6) gave at
# most 1.4e-6 in the image and 3.3e-6 of the largest gradient over the ordinary scenes below.
IMAGE_TOLERANCE = 3e-6
GRADIENT_TOLERANCE = 1e-5


def assert_close(result, image=IMAGE_TOLERANCE, gradient=GRADIENT_TOLERANCE):
    assert result.fragile < 0.05
    assert result.image < image
    assert result.depth < image
    for name, error in result.gradients.items():
        assert error < gradient, name


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize(
    ("n", "opacity", "size_px"),
    [(60, (0.05, 0.95), 5.0), (60, (0.9, 0.9999), 5.0), (250, (0.5, 0.9999), 3.0), (300, (0.05, 0.9), 0.3)],
    ids=["ordinary", "opaque", "saturated", "sub-pixel"],
)
def test_random_scene_equals_oracle(n, opacity, size_px, antialias):
    camera = make_camera()
    gaussians = make_gaussians(camera, n, opacity=opacity, size_px=size_px)
    result = compare(gaussians, camera, antialias=antialias)
    assert_close(result)
    # The scene must say something: covered, but not saturated everywhere, with gradients in every group.
    assert result.alpha.max() > 0.2
    assert result.alpha.min() < 0.99
    assert all(size > 1e-3 for size in result.gradient_sizes.values())


@pytest.mark.skipif(LANES == 8, reason="eight lanes are what the other tests use here")
def test_vectors_of_eight_lanes_equal_oracle_too():
    program = (
        "import json; from splat_scenes import compare, make_camera, make_gaussians; camera = make_camera();"
        "from cleargs.splat.kernels.cpu.simd import LANES;"
        "result = compare(make_gaussians(camera, 60, size_px=5.0), camera);"
        "print(json.dumps([LANES, result.image, max(result.gradients.values())]))"
    )
    environment = os.environ | {
        "NUMBA_CPU_NAME": "x86-64-v3",
        "NUMBA_CPU_FEATURES": "+avx2,+fma",
        "PYTHONPATH": str(Path(__file__).parent),
    }
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    lanes, image, gradient = json.loads(result.stdout)
    assert lanes == 8
    assert image < IMAGE_TOLERANCE
    assert gradient < GRADIENT_TOLERANCE


def test_saturated_scene_reaches_the_stop():
    camera = make_camera()
    alpha = compare(make_gaussians(camera, 250, opacity=(0.5, 0.9999), size_px=3.0), camera).alpha
    assert (alpha > 1 - 1.5e-4).any()
    assert (alpha < 0.99).any()


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


@pytest.mark.parametrize("count", [1, 4, 9])
def test_fewer_stored_coefficients(count):
    camera = make_camera()
    assert_close(compare(make_gaussians(camera, 40, sh_count=count), camera))


@pytest.mark.parametrize("size", [(1, 1), (1, 37), (53, 1), (16, 16), (17, 33), (70, 15)])
def test_any_image_size(size):
    camera = make_camera(*size, focal=40.0)
    result = compare(make_gaussians(camera, 30), camera)
    assert_close(result)
    assert result.alpha.max() > 0.1


@pytest.mark.parametrize("focal", [50.0, 50_000.0])
def test_extreme_focal_lengths(focal):
    camera = make_camera(focal=focal)
    # Pixel positions are focal * x / z: float32 parameters are exact here, float64 projection keeps them so.
    assert_close(compare(make_gaussians(camera, 60), camera))


def test_behind_and_across_the_near_plane():
    camera = make_camera()
    gaussians = make_gaussians(camera, 60)
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    depths = np.array([-3.0, -0.01, 0.0, 0.009, 0.011, 0.05, 0.3])
    local = np.stack([0.1 * depths, -0.2 * depths, depths], -1)
    gaussians.means[: len(depths)] = torch.tensor((local - translation) @ rotation)
    result = compare(gaussians, camera)
    # Splats centred 0.011 in front span thousands of pixels and hide most of the image; the few pixels left
    # make the largest gradient small beside the terms that it is the sum of (measured: 1e-5).
    assert_close(result, image=1e-5, gradient=3e-5)
    engine = rasteriser_for()
    engine.forward(gaussians, camera)
    assert engine.visible[:7].tolist() == [False, False, False, False, True, True, True]
    assert not engine.visible[:4].any()


def test_splat_covering_the_image():
    camera = make_camera()
    gaussians = make_gaussians(camera, 20)
    gaussians.log_scales[3] = 3.0
    assert_close(compare(gaussians, camera))


@pytest.mark.parametrize("antialias", [False, True])
def test_needles(antialias):
    """Aspect 1e4: in float32 the determinant and A dx² + 2 B dx dy + C dy² would cancel completely."""
    camera = make_camera()
    gaussians = make_gaussians(camera, 40)
    gaussians.log_scales[:] = torch.tensor([1.5, 1.5 - np.log(1e4), 1.5 - np.log(1e4)], dtype=torch.float32)
    # A needle's ridge moves by 1e-5 px with the rounding of the mean, which its thin side feels.
    assert_close(compare(gaussians, camera, antialias=antialias), image=2e-5, gradient=5e-5)


def test_huge_and_tiny_scales():
    camera = make_camera()
    gaussians = make_gaussians(camera, 40)
    gaussians.log_scales[0] = 30.0
    gaussians.log_scales[1] = -30.0
    gaussians.log_scales[2] = torch.tensor([10.0, -10.0, 0.0])
    # An aspect of 5e8 leaves the float64 oracle itself, which does cancel, eight digits less.
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
    gaussians.rotations[3] *= 1e6  # its gradient of 1e6 times the others' would hide them
    assert_close(compare(gaussians, camera))


def test_opacity_zero_and_one():
    camera = make_camera()
    gaussians = make_gaussians(camera, 60)
    gaussians.logit_opacities[:10] = 50.0  # exactly 1: clamped to 0.999 at the centre
    gaussians.logit_opacities[10:20] = -50.0
    gaussians.logit_opacities[20] = float("-inf")
    gaussians.logit_opacities[21] = float("inf")
    finite = gaussians.select(torch.arange(60) != 20)
    assert_close(compare(finite, camera))
    live = leaves(gaussians, torch.float32)
    render(live, camera).image.sum().backward()
    assert all(tensor.grad.isfinite().all() for tensor in live.tensors().values())
    assert not live.logit_opacities.grad[10:22].any()


def test_many_splats_at_one_depth_are_ordered_by_index():
    camera = Camera(32, 32, 30.0, 30.0, 16.0, 16.0, np.eye(4))
    gaussians = make_gaussians(camera, 1000, opacity=(0.02, 0.3), size_px=3.0)
    gaussians.means[:, 2] = 4.0
    assert_close(compare(gaussians, camera))
    reversed_order = gaussians.select(torch.arange(999, -1, -1))
    assert not torch.allclose(
        render(gaussians, camera).image, render(reversed_order, camera).image, atol=1e-3
    )


@pytest.mark.parametrize("n", [0, 5])
def test_nothing_visible(n):
    camera = make_camera()
    gaussians = make_gaussians(camera, n)
    gaussians.means[:] = -gaussians.means - 20.0
    live = leaves(gaussians, torch.float32)
    result = render(live, camera, background=BACKGROUND)
    torch.testing.assert_close(result.image, torch.tensor(BACKGROUND).expand(48, 64, 3), rtol=0, atol=0)
    assert not result.alpha.any()
    assert not result.depth.any()
    result.image.sum().backward()
    assert all(not tensor.grad.any() for tensor in live.tensors().values())


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("name", ["means", "log_scales", "rotations", "logit_opacities", "sh"])
def test_a_splat_that_is_not_finite_is_culled(name, value):
    camera = make_camera()
    gaussians = make_gaussians(camera, 30)
    others = gaussians.select(torch.arange(30) != 7)
    getattr(gaussians, name)[7] = value
    engine = rasteriser_for()
    image = engine.forward(gaussians, camera, background=BACKGROUND).image.clone()
    gradients = engine.backward(torch.ones_like(image))
    assert image.isfinite().all()
    assert all(tensor.isfinite().all() for tensor in gradients.tensors().values())
    harmless = (name, value) in {("log_scales", float("-inf")), ("logit_opacities", float("inf"))}
    if not harmless:
        assert not engine.visible[7]
        torch.testing.assert_close(image, render(others, camera, background=BACKGROUND).image, rtol=0, atol=0)


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
    """A splat centred on a pixel: alpha is its opacity there, depth alpha z, colour over background."""
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
