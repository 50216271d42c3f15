"""Cameras, tile lists, and finite differences of the whole rendering."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.splat_scenes import BACKGROUND, leaves, make_camera, make_gaussians, make_needles

from benchmarks.speed import reference
from cleargs.capture.tables import Frame
from cleargs.errors import InputError
from cleargs.scene.views import view_of
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu import binning, projection
from cleargs.splat.kernels.rasteriser import view_numbers
from cleargs.splat.kernels.splat_layout import SPLAT_COLUMNS, TILE
from cleargs.splat.render import render

PARAMETERS = ["means", "log_scales", "rotations", "logit_opacities", "sh"]


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize(
    ("name", "output"),
    [(name, "image") for name in PARAMETERS]
    + [(name, output) for name in PARAMETERS[:-1] for output in ("alpha", "depth")],  # colour is in neither
)
def test_gradient_equals_finite_differences(name, output, antialias):
    """Compare central differences of the oracle along random directions with the kernels' gradient.

    The image jumps where an alpha crosses 1/255, so only pixels far from such a jump count. With a step of
    1e-6, the float64 difference quotient is accurate to about 1e-8, and the float32 gradient to about 1e-6.
    """
    camera = make_camera(32, 24)
    gaussians = make_gaussians(camera, 25, size_px=3.0)
    exact = leaves(gaussians, torch.float64).detach()
    safe = reference.render(exact, camera, background=BACKGROUND, antialias=antialias).margin > 2e-3
    assert safe.double().mean() > 0.6
    generator = torch.Generator().manual_seed(3)
    weights = torch.randn(24, 32, 3, generator=generator, dtype=torch.float64) * safe[..., None]
    weights = weights if output == "image" else weights[..., 0]

    def functional(draw, scene):
        result = draw(scene, camera, background=BACKGROUND, antialias=antialias)
        return (getattr(result, output) * weights).sum()

    live = leaves(gaussians, torch.float32)
    functional(render, live).backward()
    gradient = getattr(live, name).grad.double()
    errors = []
    for _ in range(3):
        direction = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
        values = []
        for sign in (1, -1):
            moved = Gaussians(**{**exact.tensors(), name: getattr(exact, name) + sign * 1e-6 * direction})
            values.append(functional(reference.render, moved).item())
        slope = (values[0] - values[1]) / 2e-6
        size = (gradient * direction).abs().sum().item()
        assert size > 0.1
        errors.append(abs(slope - (gradient * direction).sum().item()) / size)
    assert np.median(errors) < 3e-6


def project(gaussians, camera, antialias=False):
    n = gaussians.num
    splats, tiles, radii = (
        np.zeros((n, SPLAT_COLUMNS), np.float32),
        np.empty(n, np.int64),
        np.empty(n, np.float32),
    )
    arrays = [tensor.numpy() for tensor in gaussians.tensors().values()]
    view = projection.ProjectionView(*view_numbers(camera))
    projection.project(
        tuple(arrays),
        16,
        view,
        np.empty((0, 12)),
        antialias,
        camera.width,
        camera.height,
        splats,
        tiles,
        radii,
    )
    return splats, tiles, radii


@pytest.mark.parametrize("kind", ["round", "long", "needle"])
def test_tiles_hold_every_touched_pixel_and_few_others(kind):
    """Compare the tile list with alpha >= 1/255 at every pixel of the float64 projection."""
    if kind in ("round", "long"):
        camera = make_camera(150, 100)
        gaussians = make_gaussians(camera, 60, size_px=8.0, aspect=2.0 if kind == "round" else 30.0)
    else:
        camera = make_camera(160, 96)  # whole tiles: the edge where needles leave the image is not tested
        gaussians = make_needles(camera, 100, length_px=1e7, aspect=1e6)
    splats, tiles, radii = project(gaussians, camera)
    offsets = np.concatenate([[0], np.cumsum(tiles)])
    pairs = np.empty(offsets[-1], np.uint32)
    binning.list_pairs(splats, offsets, camera.width, camera.height, pairs)
    tiles_x = -(-camera.width // TILE)

    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    needed = listed = 0
    for g in range(gaussians.num):
        one = leaves(gaussians.select(torch.tensor([g])), torch.float64).detach()
        truth = reference.project(one, camera, 16, False)
        (mx, my), (a, b, c) = truth.means[0].numpy(), truth.conics[0].numpy()
        power = 0.5 * (a * (x - mx) ** 2 + 2 * b * (x - mx) * (y - my) + c * (y - my) ** 2)
        rows, columns = np.nonzero(truth.opacities[0].item() * np.exp(-power) >= 1 / 255)
        touched = set(rows // TILE * tiles_x + columns // TILE)
        mine = pairs[offsets[g] : offsets[g + 1]].tolist()
        assert touched <= set(mine)
        assert len(mine) == len(set(mine))
        if touched:
            assert np.abs(columns + 0.5 - mx).max() <= radii[g] + 1e-3
        needed += len(touched)
        listed += len(mine)
    assert needed > 100
    # The ellipse is cut at the outer pixel centres of each row of tiles, so almost no tile is listed in vain.
    assert listed <= 1.02 * needed + 2


@pytest.mark.parametrize("chunks", [1, 3])
def test_order_is_by_depth_then_index(chunks):
    n = 3000
    rng = np.random.default_rng(0)
    splats = np.zeros((n, SPLAT_COLUMNS), np.float32)
    splats[:, 9] = rng.choice(np.concatenate([rng.uniform(0.01, 1e4, 200), [0.01, 1e30]]), n)
    tiles = rng.integers(0, 2, n)
    visible = np.flatnonzero(tiles)
    scratch = [np.empty((2, len(visible)), np.uint32) for _ in range(2)]
    counts = np.empty((chunks, binning.RADIX), np.int64)
    order = scratch[1][binning.depth_order(splats, tiles, counts, *scratch)]
    expected = visible[np.argsort(splats[visible, 9], kind="stable")]
    np.testing.assert_array_equal(order, expected)


def test_camera():
    pose = {
        "qw": 2 * np.cos(0.3),
        "qx": 0.0,
        "qy": 2 * np.sin(0.3),
        "qz": 0.0,
        "tx": 1.0,
        "ty": 2.0,
        "tz": 3.0,
    }
    lens = {"width": 100, "height": 50, "fx": 80.0, "fy": 70.0, "cx": 51.0, "cy": 24.0}
    rest = {"name": "a", "time_s": None, "n_points": 0, "split": "train", "placed": None, "mask": None}
    frame = Frame(frame_id=0, image="images/000000.png", registered=True, **pose, **lens, **rest)
    camera = view_of(frame, Path(), 1.0).camera
    # A rotation by 0.6 rad about y moves z to x = sin 0.6.
    np.testing.assert_allclose(camera.world_to_camera[:3, 2], [np.sin(0.6), 0, np.cos(0.6)], atol=1e-15)
    np.testing.assert_allclose(camera.world_to_camera @ [*camera.centre, 1], [0, 0, 0, 1], atol=1e-15)
    half = camera.scaled(0.5)
    assert (half.width, half.height, half.fx, half.fy, half.cx, half.cy) == (50, 25, 40, 35, 25.5, 12)
    assert camera.scaled(1e-6).width == 1
    with pytest.raises(InputError, match=r"not usable: 10x10, fx fy cx cy = \(0\.0, 1\.0"):
        Camera(10, 10, 0.0, 1.0, 5.0, 5.0, np.eye(4))
    with pytest.raises(InputError, match="not usable"):
        Camera(10, 10, 1.0, 1.0, float("nan"), 5.0, np.eye(4))


def test_scaled_camera_sees_the_same():
    """A render at twice the resolution, averaged 2 x 2, is close to the original if splats are large."""
    camera = make_camera(32, 24)
    gaussians = make_gaussians(camera, 20, size_px=8.0)
    fine = render(gaussians, camera.scaled(2.0)).image.reshape(24, 2, 32, 2, 3).mean(dim=(1, 3))
    assert (fine - render(gaussians, camera).image).abs().mean() < 0.01


@pytest.mark.parametrize("antialias", [False, True])
def test_a_splat_does_not_depend_on_its_neighbours(antialias):
    camera = make_camera(150, 100)
    gaussians = make_gaussians(camera, 1500, size_px=4.0, aspect=5.0)
    order = torch.from_numpy(np.random.default_rng(3).permutation(1500))
    splats, tiles, radii = project(gaussians, camera, antialias)
    for chosen in (order, order[:700], order[:3]):
        others = project(gaussians.select(chosen), camera, antialias)
        for one, other in zip((splats, tiles, radii), others, strict=True):
            assert np.array_equal(one[chosen], other)
