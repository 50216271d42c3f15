"""The rasteriser in pure torch computes the same image and gradients as the oracle."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from benchmarks.speed import reference, torch_tiles
from benchmarks.speed.reference import Splats
from benchmarks.speed.torch_tiles import TILE, groups, pixel_centres, rasterise, tile_lists
from cleargs.splat import constants
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.random_scene import random_scene

WIDTH, HEIGHT = 45, 35


def scene() -> tuple[Gaussians, Camera]:
    """Float64 scene with saturated and almost empty pixels; sizes are not multiples of the tile."""
    gaussians, camera = random_scene(500, WIDTH, HEIGHT, sigma=3.0)
    gaussians.logit_opacities[:100] = 6.0
    leaves = {name: tensor.double().requires_grad_() for name, tensor in gaussians.tensors().items()}
    return Gaussians(**leaves), camera


def project(gaussians: Gaussians, camera: Camera) -> Splats:
    return reference.project(gaussians, camera, 16, antialias=False)


def detached(splats: Splats) -> Splats:
    return Splats(*(tensor.detach() for tensor in splats))


def stacked_tiles(splats: Splats) -> Tensor:
    stacked = groups(*tile_lists(detached(splats), WIDTH, HEIGHT), len(splats.depths))
    return rasterise(splats, stacked, WIDTH, HEIGHT)


def test_image_and_gradients_agree_with_the_oracle():
    gaussians, camera = scene()
    image = stacked_tiles(project(gaussians, camera))
    truth = reference.render(gaussians, camera)
    assert truth.alpha.max() > 1 - 2 * constants.TRANSMITTANCE_STOP and truth.alpha.min() < 0.99
    # Both are in float64; only the order of operations differs.
    torch.testing.assert_close(image, truth.image, rtol=0, atol=1e-11)
    weight = torch.randn(HEIGHT, WIDTH, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    leaves = list(gaussians.tensors().values())
    ours = torch.autograd.grad(image, leaves, weight)
    exact = torch.autograd.grad(truth.image, leaves, weight)
    for gradient, expected in zip(ours, exact, strict=True):
        assert expected.abs().max() > 0
        torch.testing.assert_close(gradient, expected, rtol=0, atol=1e-10 * float(expected.abs().max()))


def test_tile_lists_are_exact():
    gaussians, camera = scene()
    splats = detached(project(gaussians, camera))
    counts, ids = tile_lists(splats, WIDTH, HEIGHT)
    across, down = -(-WIDTH // TILE), -(-HEIGHT // TILE)
    centres = pixel_centres(torch.arange(across * down), across, torch.float64)
    inside = (centres[..., 0] < WIDTH) & (centres[..., 1] < HEIGHT)
    a, b, c = splats.conics.unbind(-1)
    for tile, found in enumerate(torch.split(ids, counts.tolist())):
        dx, dy = (centres[tile][:, None] - splats.means[None]).unbind(-1)
        alpha = splats.opacities * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        reaches = ((alpha >= constants.ALPHA_CUT) & inside[tile, :, None]).any(0)
        assert torch.equal(found, torch.nonzero(reaches).squeeze(1))


@pytest.mark.parametrize("size", [1, 1 << 14, 1 << 22])
def test_groups_contain_every_pair_once(size, monkeypatch):
    monkeypatch.setattr(torch_tiles, "GROUP_PRODUCTS", size)
    gaussians, camera = scene()
    splats = detached(project(gaussians, camera))
    counts, ids = tile_lists(splats, WIDTH, HEIGHT)
    padding = len(splats.depths)
    stacked = groups(counts, ids, padding)
    found = {
        int(tile): row[row < padding]
        for group in stacked
        for tile, row in zip(group.tiles, group.ids, strict=True)
    }
    assert sum(len(group.tiles) for group in stacked) == len(found) == int((counts > 0).sum())
    for tile, row in enumerate(torch.split(ids, counts.tolist())):
        assert torch.equal(found.get(tile, row[:0]), row)


def test_empty_tiles_stay_black():
    gaussians, camera = random_scene(3, 64, 64, sigma=0.5)
    splats = detached(project(Gaussians(**{k: t.double() for k, t in gaussians.tensors().items()}), camera))
    stacked = groups(*tile_lists(splats, 64, 64), 3)
    image = rasterise(splats, stacked, 64, 64)
    assert 0 < int((image.amax(2) > 0).sum()) < 200
