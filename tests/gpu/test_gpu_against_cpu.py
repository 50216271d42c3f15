"""The GPU back end compared with the CPU's, on scenes too large for the interpreter: needs a GPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.splat_scenes import make_camera, make_gaussians
from helpers.warp_oracle import ALL, LONG, ROLLED

from cleargs.formation.warp import Warp, displacement_fields
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.cuda import support


@pytest.fixture(autouse=True)
def needs_a_device(device):
    if device.type != "cuda":
        pytest.skip("needs a GPU: the interpreter would take hours")


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize(("count", "size_px", "aspect"), [(20_000, 2.0, 2.0), (3_000, 12.0, 30.0)])
def test_the_gpu_agrees_with_the_cpu(count, size_px, aspect, antialias, device):
    camera = make_camera(633, 357)
    gaussians = make_gaussians(camera, count, size_px=size_px, aspect=aspect)
    upstream = torch.randn(357, 633, 3, generator=torch.Generator().manual_seed(0))
    results = []
    for where in ("cpu", device):
        engine = rasteriser_for(where)
        image = engine.forward(gaussians.to(where), camera, antialias=antialias).image
        gradients = engine.backward(upstream.to(where))
        results.append((image.cpu(), gradients.to("cpu"), engine.visible.cpu()))
    (image, gradients, visible), (other_image, other_gradients, other_visible) = results
    assert torch.equal(visible, other_visible)
    assert visible.double().mean() > 0.5
    # A pixel whose alpha is on the cut may be on either side: 1/255 of one splat's colour, in few pixels.
    apart = (image - other_image).abs().amax(dim=2)
    assert (apart > 1e-5).double().mean() < 1e-3
    assert apart.max() < 0.05
    for name, gradient in gradients.tensors().items():
        error = (getattr(other_gradients, name) - gradient).double()
        assert error.norm() < 1e-3 * gradient.double().norm(), name


@pytest.mark.parametrize("motion", [ALL, ROLLED, LONG], ids=["many samples", "one sample", "two passes"])
def test_the_warp_agrees_with_the_cpu_and_with_itself(motion, device):
    width, height = 633, 357
    camera = Camera(width, height, 500.0, 510.0, 310.0, 180.0, np.eye(4))
    generator = torch.Generator().manual_seed(0)
    depth = 2.0 + torch.rand(height + 16, width + 16, generator=generator)
    image, light = (torch.rand(h, w, 4, generator=generator) for h, w in (depth.shape, (height, width)))
    found = []
    for where in ("cpu", device, device):
        placed = depth.to(where)
        fields = displacement_fields(motion, camera, placed, torch.ones_like(placed), 8)
        warp = Warp.of(fields, 8)
        found.append((warp.forward(image.to(where)).cpu(), warp.transpose(light.to(where)).cpu()))
    # Positions of up to 640 px in float32 are exact to 6e-5 px. About a hundred pixels add to one place.
    assert (found[1][0] - found[0][0])[..., :3].abs().max() < 3e-4
    assert (found[1][1] - found[0][1])[..., :3].abs().max() < 1e-3
    assert all(torch.equal(first, second) for first, second in zip(found[1], found[2], strict=True))


def test_memory_is_bounded_and_grows_with_the_scene(device):
    engine, camera = rasteriser_for(device), make_camera(640, 360)
    small, large = (make_gaussians(camera, count, size_px=2.0).to(device) for count in (5_000, 50_000))
    for gaussians in (small, large, small, large):
        engine.backward(torch.ones_like(engine.forward(gaussians, camera).image))
    held = torch.cuda.memory_allocated(device)
    for _ in range(5):
        engine.backward(torch.ones_like(engine.forward(large, camera).image))
    assert torch.cuda.memory_allocated(device) <= held


def test_a_full_memory_names_what_to_change(device):
    from cleargs.errors import StageError

    with pytest.raises(StageError, match="memory is full"), support.memory_errors():
        torch.empty(2**50, dtype=torch.uint8, device=device)
