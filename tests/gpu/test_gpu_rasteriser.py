"""The GPU kernels against the float64 oracle: image, alpha, depth and all gradients.

Scenes are small, since Triton's interpreter takes milliseconds for every (tile, splat) pair.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gpu_checks import assert_close
from splat_scenes import BACKGROUND, compare, make_camera, make_gaussians

from cleargs.errors import StageError
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.kernels import rasteriser
from cleargs.splat.kernels.cuda import support
from cleargs.splat.render import render

pytestmark = pytest.mark.usefixtures("compare_on_device")


@pytest.mark.parametrize(
    ("n", "opacity", "size_px", "antialias"),
    [
        (30, (0.05, 0.95), 4.0, False),
        (30, (0.05, 0.95), 4.0, True),
        (30, (0.9, 0.9999), 4.0, False),
        (70, (0.05, 0.9), 0.3, True),
    ],
    ids=["ordinary", "antialias", "opaque", "sub-pixel"],
)
def test_random_scene_equals_oracle(n, opacity, size_px, antialias):
    camera = make_camera(36, 27)
    result = compare(make_gaussians(camera, n, opacity=opacity, size_px=size_px), camera, antialias=antialias)
    assert_close(result)
    assert result.alpha.max() > 0.2
    assert result.alpha.min() < 0.99
    assert all(size > 1e-3 for size in result.gradient_sizes.values())


def test_several_chunks_a_tile_and_the_stop():
    """150 splats on one tile: three chunks, some pixels stop in the first, others never."""
    camera = make_camera(16, 14, focal=20.0)
    gaussians = make_gaussians(camera, 150, opacity=(0.3, 0.999), size_px=1.0)
    result = compare(gaussians, camera)
    assert_close(result)
    assert (result.alpha > 1 - 1.5e-4).any()
    assert (result.alpha < 0.99).any()


@pytest.mark.parametrize(("stored", "degree"), [(16, 0), (16, 2), (9, None), (4, None), (1, None)])
def test_sh_degrees(stored, degree):
    camera = make_camera(20, 18)
    assert_close(compare(make_gaussians(camera, 12, sh_count=stored), camera, sh_degree=degree))


@pytest.mark.parametrize("size", [(1, 1), (1, 37), (35, 1), (16, 16), (17, 33)])
def test_any_image_size(size):
    camera = make_camera(*size, focal=40.0)
    result = compare(make_gaussians(camera, 20), camera)
    assert_close(result)
    assert result.alpha.max() > 0.1


def test_behind_and_across_the_near_plane(device):
    camera = make_camera(30, 24)
    gaussians = make_gaussians(camera, 25)
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    depths = np.array([-3.0, -0.01, 0.0, 0.009, 0.011, 0.05, 0.3])
    local = np.stack([0.1 * depths, -0.2 * depths, depths], -1)
    gaussians.means[: len(depths)] = torch.tensor((local - translation) @ rotation)
    # Splats centred 0.011 in front hide most of the image, as in the CPU's test.
    assert_close(compare(gaussians, camera), image=1e-5, gradient=3e-5)
    engine = rasteriser_for(device)
    engine.forward(gaussians.to(device), camera)
    assert engine.visible[:7].tolist() == [False, False, False, False, True, True, True]
    assert not engine.visible[:4].any()


@pytest.mark.parametrize("antialias", [False, True])
def test_needles(antialias):
    camera = make_camera(36, 27)
    gaussians = make_gaussians(camera, 16)
    gaussians.log_scales[:] = torch.tensor([1.5, 1.5 - np.log(1e4), 1.5 - np.log(1e4)], dtype=torch.float32)
    assert_close(compare(gaussians, camera, antialias=antialias), image=2e-5, gradient=5e-5)  # as on the CPU


def test_opacity_zero_and_one(device):
    camera = make_camera(36, 27)
    gaussians = make_gaussians(camera, 24)
    gaussians.logit_opacities[:6] = 50.0  # exactly 1: clamped to 0.999 at the centre
    gaussians.logit_opacities[6:12] = -50.0
    assert_close(compare(gaussians, camera))
    gaussians.logit_opacities[12] = float("-inf")
    gaussians.logit_opacities[13] = float("inf")
    engine = rasteriser_for(device)
    image = engine.forward(gaussians.to(device), camera).image
    gradients = engine.backward(torch.ones_like(image))
    assert all(tensor.isfinite().all() for tensor in gradients.tensors().values())
    assert not gradients.logit_opacities[6:13].any()


def test_splats_at_one_depth_are_ordered_by_index(device):
    camera = Camera(16, 16, 15.0, 15.0, 8.0, 8.0, np.eye(4))
    gaussians = make_gaussians(camera, 60, opacity=(0.05, 0.5), size_px=3.0)
    gaussians.means[:, 2] = 4.0
    assert_close(compare(gaussians, camera))
    backwards = gaussians.select(torch.arange(59, -1, -1)).to(device)
    assert not torch.allclose(
        render(gaussians.to(device), camera).image, render(backwards, camera).image, atol=1e-3
    )


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


def test_two_runs_give_the_same_bits_and_buffers_are_used_again(device):
    camera = make_camera(36, 27)
    gaussians = make_gaussians(camera, 20).to(device)
    engine = rasteriser_for(device)
    outcomes = []
    for _ in range(2):
        image = engine.forward(gaussians, camera).image
        memory, first = image.data_ptr(), image.clone()
        gradients = engine.backward(torch.sin(first)).clone()
        engine.forward(gaussians.select(torch.arange(10, device=device)), make_camera(20, 18))
        outcomes.append((memory, first, *gradients.tensors().values()))
    (memory, *first), (again, *second) = outcomes
    assert memory == again
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_depth_gradient_needs_a_forward_with_depth(device):
    camera = make_camera(16, 16)
    engine = rasteriser_for(device)
    image = engine.forward(make_gaussians(camera, 4).to(device), camera).image
    with pytest.raises(ValueError, match="depth"):
        engine.backward(image, None, image[..., 0])


def test_too_many_pairs_is_an_error(device, monkeypatch):
    monkeypatch.setattr(rasteriser, "MAX_PAIRS", 10)
    camera = make_camera(36, 27)
    with pytest.raises(StageError, match="pairs"):
        rasteriser_for(device).forward(make_gaussians(camera, 20).to(device), camera)


def test_pairs_that_do_not_fit_are_refused_before_they_are_made(device, monkeypatch):
    monkeypatch.setattr(rasteriser, "UNASKED", 0)
    camera = make_camera(20, 18)
    gaussians = make_gaussians(camera, 12).to(device)
    engine = rasteriser_for(device)
    monkeypatch.setattr(rasteriser, "available_memory", lambda device: 100)
    with pytest.raises(StageError, match=r"12 Gaussians touch .* more than fit"):
        engine.forward(gaussians.select(torch.arange(12, device=device)), camera)
    monkeypatch.undo()
    assert support.available_memory(device) > 2**20


def test_exhausted_memory_names_the_settings():
    with pytest.raises(StageError, match="memory") as caught, support.memory_errors():
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.\nMore.")
    assert "budget" in caught.value.hint
