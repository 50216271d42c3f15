"""Hard cases against the float64 oracle, beside those of ``test_rasteriser``."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_scenes import BACKGROUND, at, compare, leaves, make_camera, make_gaussians, make_needles

from cleargs.splat.backend import adam_step, photometric_loss, rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels import reference
from cleargs.splat.render import render
from cleargs.splat.types import AdamStep


def assert_close(result, image, gradient):
    assert result.fragile < 0.05
    assert result.image < image
    assert result.depth < image
    for name, error in result.gradients.items():
        assert error < gradient, name


def join(*parts: Gaussians) -> Gaussians:
    groups = [part.tensors() for part in parts]
    return Gaussians(**{name: torch.cat([group[name] for group in groups]) for name in groups[0]})


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize(
    ("distance", "image", "gradient"), [(1500.0, 2e-4, 5e-4), (5e3, 5e-3, 2e-2), (5e4, 5e-3, 2e-2)]
)
def test_needles_centred_far_away(distance, image, gradient, antialias):
    """The centre of a needle may lie thousands of px from the image that its tip crosses.

    The rasteriser holds the centre in float32, to 6e-8 of the distance (3e-3 px at 5e4 px), and the needle's
    thin side of 0.55 px feels that. Measuring from a nearer point of the needle would mend it (2e-5) and
    costs every splat 7 to 17 % of the forward pass.
    """
    camera = make_camera()
    needles = make_needles(camera, 40, length_px=distance, aspect=1e4, distance=distance)
    result = compare(needles, camera, antialias=antialias)
    assert result.alpha.max() > 0.2
    assert_close(result, image, gradient)


@pytest.mark.parametrize("antialias", [False, True])
def test_determinant_that_rounds_to_zero_or_below(antialias):
    """Needles of 1e4 px: of xx yy - xy², two products of 1e15, 3e7 is left, beyond float32's seven digits."""
    camera = make_camera()
    needles = make_needles(camera, 40, length_px=1e4, aspect=1e5)
    conics = reference.project(leaves(needles, torch.float64).detach(), camera, 16, antialias).conics
    covariances = torch.linalg.inv(conics[:, [0, 1, 1, 2]].reshape(-1, 2, 2)).float()
    naive = covariances[:, 0, 0] * covariances[:, 1, 1] - covariances[:, 0, 1] ** 2
    assert (naive <= 0).sum() > 5
    result = compare(needles, camera, antialias=antialias)
    assert_close(result, image=2e-5, gradient=5e-5)


def test_no_thickness_at_all():
    """Disks seen edge-on, lines seen end-on and points: the covariance before dilation has rank 1 or 0."""
    camera = make_camera()
    gaussians = make_gaussians(camera, 40)
    gaussians.log_scales[:20, 0] = -100.0
    gaussians.log_scales[10:20, 1] = -100.0
    gaussians.log_scales[20:30] = -100.0
    assert_close(compare(gaussians, camera), image=3e-6, gradient=1e-5)
    # Anti-aliasing makes what has no area invisible, with no gradient rather than one of 0 / 0.
    engine = rasteriser_for()
    image = engine.forward(gaussians, camera, antialias=True).image
    assert not engine.visible[10:30].any()
    assert engine.visible[30:].any()
    gradients = engine.backward(torch.ones_like(image))
    assert all(tensor.isfinite().all() for tensor in gradients.tensors().values())
    assert all(not tensor[10:30].any() for tensor in gradients.tensors().values())


def test_a_wall_facing_a_turned_camera_is_ordered_by_depth_then_index():
    """A thousand splats at one depth, up to the rounding of their means: in float32 it is two depths."""
    camera = make_camera(32, 32)
    gaussians = make_gaussians(camera, 1000, opacity=(0.02, 0.3), size_px=3.0)
    pose = torch.as_tensor(camera.world_to_camera)
    local = gaussians.means.double() @ pose[:3, :3].T + pose[:3, 3]
    gaussians.means[:] = at(camera, (local * (4.0 / local[:, 2:])).numpy())
    depths = gaussians.means.double() @ pose[2, :3] + pose[2, 3]
    assert len(depths.unique()) > 900
    assert len(depths.float().unique()) == 2
    # As for ordinary scenes; a pair blended in the other order moves a pixel by 1e-2.
    assert_close(compare(gaussians, camera), image=3e-6, gradient=1e-5)


@pytest.mark.parametrize("antialias", [False, True])
def test_all_transparent(antialias):
    """Every opacity just below 1/255: exactly the background and exactly no gradient, as the oracle says."""
    camera = make_camera()
    gaussians = make_gaussians(camera, 40)
    gaussians.logit_opacities[:] = float(-np.log(255.1 - 1))
    live, exact = leaves(gaussians, torch.float32), leaves(gaussians, torch.float64)
    for scene in (live, exact):
        result = render(scene, camera, background=BACKGROUND, antialias=antialias)
        colour = torch.tensor(BACKGROUND, dtype=scene.means.dtype)
        assert torch.equal(result.image, colour.expand(48, 64, 3))
        assert not result.alpha.any()
        assert not result.depth.any()
        (result.image.sum() + result.alpha.sum() + result.depth.sum()).backward()
        assert all(not tensor.grad.any() for tensor in scene.tensors().values())
    gaussians.logit_opacities[:] = float(-np.log(254.9 - 1))
    wide = gaussians.clone()
    wide.log_scales[:] = 1.0
    assert render(wide, camera).alpha.any()


def test_what_saturated_pixels_hide_has_no_gradient():
    """Behind an opaque wall T is under 1e-4: hidden splats get exactly 0, those beside the wall do not."""
    camera = Camera(64, 32, 60.0, 60.0, 32.0, 16.0, np.eye(4))
    gaussians = make_gaussians(camera, 60, size_px=1.0)
    wall, hidden = slice(0, 8), slice(8, 20)
    gaussians.means[wall] = torch.tensor([-0.4, 0.0, 1.0])  # at (8, 16) px, 15 px wide
    gaussians.log_scales[wall] = float(np.log(0.25))
    gaussians.logit_opacities[wall] = 5.0
    gaussians.means[hidden] = torch.tensor([-2.0, 0.0, 5.0])
    result = compare(gaussians, camera)
    assert_close(result, image=3e-6, gradient=1e-5)
    assert (result.alpha > 1 - 1.5e-4).any()
    assert (result.alpha < 0.5).any()
    engine = rasteriser_for()
    image = engine.forward(gaussians, camera).image
    gradients = engine.backward(torch.ones_like(image))
    assert engine.visible[hidden].all()
    assert all(not tensor[hidden].any() for tensor in gradients.tensors().values())
    assert gradients.sh[wall].any()
    assert gradients.sh[20:].any()


def test_depths_beyond_float32_are_culled():
    """The depth of finite means may still overflow, which would leave infinity in the depth of the pixels."""
    camera = make_camera()
    gaussians = make_gaussians(camera, 30)
    others = gaussians.select(torch.arange(30) != 7)
    gaussians.means[7] = 3.4e38 * torch.as_tensor(np.sign(camera.world_to_camera[2, :3]), dtype=torch.float32)
    gaussians.log_scales[7] = 88.0
    expected = render(others, camera)
    result = render(gaussians, camera)
    assert torch.equal(result.image, expected.image)
    assert torch.equal(result.depth, expected.depth)


def test_weight_zero_gives_exactly_no_gradient_and_weight_one_that_of_no_weight():
    camera = make_camera()
    gaussians = make_gaussians(camera, 60)
    target = torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(1))
    engine = rasteriser_for()
    image = engine.forward(gaussians, camera, background=BACKGROUND).image

    def gradients(**weight: float) -> Gaussians:
        return engine.backward(photometric_loss(image, target, ssim_lambda=0.2, **weight).grad_image).clone()

    assert all(not tensor.any() for tensor in gradients(weight=0.0).tensors().values())
    plain, one, two = gradients(), gradients(weight=1.0), gradients(weight=2.0)
    for name, tensor in plain.tensors().items():
        assert tensor.any(), name
        assert torch.equal(tensor, getattr(one, name)), name
        # Doubling is exact in binary: the weight is one factor of the loss, and nothing else.
        assert torch.equal(2.0 * tensor, getattr(two, name)), name


def test_training_on_every_hard_case_at_once_stays_finite():
    camera = make_camera()
    odd = make_gaussians(camera, 60)
    odd.log_scales[:10] = torch.linspace(-60, 30, 10)[:, None]
    odd.rotations[10:20] = 0.0
    odd.rotations[20:30] *= torch.logspace(-20, 15, 10)[:, None]
    odd.logit_opacities[30:40] = torch.linspace(-90, 90, 10)
    odd.means[40:50] = at(camera, np.linspace(-0.02, 0.03, 10)[:, None] * [0.3, -0.2, 1.0])
    odd.sh[50:55] *= 1e4
    needles = make_needles(camera, 20, length_px=1e4, aspect=1e6)
    far = make_needles(camera, 20, length_px=1e6, aspect=1e4, distance=1e6)
    scene = join(odd, needles, far)
    target = torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(1))
    moments = {name: (torch.zeros_like(t), torch.zeros_like(t)) for name, t in scene.tensors().items()}
    engine = rasteriser_for()
    for step in range(1, 21):
        image = engine.forward(scene, camera, antialias=step % 2 == 0).image
        loss = photometric_loss(image, target, ssim_lambda=0.2)
        assert np.isfinite(loss.loss)
        for name, gradient in engine.backward(loss.grad_image).tensors().items():
            assert gradient.isfinite().all(), (step, name)
            adam_step(AdamStep(getattr(scene, name), gradient, *moments[name], step, 1e-2))
            assert getattr(scene, name).isfinite().all(), (step, name)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(5, 80),
    width=st.integers(1, 70),
    height=st.integers(1, 50),
    focal=st.floats(20.0, 2000.0),
    size_px=st.floats(0.1, 40.0),
    aspect=st.floats(1.0, 1000.0),
    opacity=st.sampled_from([(0.005, 0.1), (0.05, 0.95), (0.9, 0.9999)]),
    degree=st.integers(0, 3),
    antialias=st.booleans(),
)
def test_any_scene_equals_oracle(
    seed, count, width, height, focal, size_px, aspect, opacity, degree, antialias
):
    camera = make_camera(width, height, focal)
    gaussians = make_gaussians(camera, count, seed=seed, opacity=opacity, size_px=size_px, aspect=aspect)
    # T = 1 - 0.999 is off by 2e-3 of itself where 2^x is by 2e-6, and may pass 1e-4 that much too early.
    result = compare(gaussians, camera, sh_degree=degree, antialias=antialias, margin=2e-3)
    # 2,000 more scenes gave at most 4e-6 and 1.1e-4; the latter where the largest gradient is itself what two
    # larger terms leave. The rotations of spheres have no gradient but noise: theirs is held against scale's.
    assert result.image < 1e-5
    assert result.depth < 1e-5
    sizes = result.gradient_sizes
    for name, error in result.gradients.items():
        scale = max(sizes[name], sizes["log_scales"]) if name == "rotations" else sizes[name]
        assert error * sizes[name] <= 3e-4 * scale, name
