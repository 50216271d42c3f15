"""The frame warp on the GPU kernels: against float64 and the CPU's, on hard cases, and inside a training."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import splat_toy
import torch
from torch import Tensor
from warp_oracle import ALL, LONG, ROLLED, constant_fields, dot, oracle, random_image

from cleargs.formation.capture import CaptureFormation
from cleargs.formation.frame import FrameFormation
from cleargs.formation.motion import FrameMotion
from cleargs.formation.warp import (
    Warp,
    displacement_fields,
    enough_samples,
    linear_curve,
    srgb_curve,
    through_curve,
    times_slope,
)
from cleargs.progress import SilentReporter
from cleargs.splat.camera import Camera
from cleargs.splat.config import FormationConfig, TrainConfig
from cleargs.splat.kernels.cuda import support
from cleargs.splat.kernels.warp_layout import CHANNELS, CURVE_LAST, DisplacementFields
from cleargs.splat.trainer import Trained, train

SMALL = Camera(30, 18, 25.0, 26.0, 14.0, 9.5, np.eye(4))
SCALE = 0.25
"""Of a small photograph over that of `ALL`, whose blur is 10 px long."""

Both = Callable[..., tuple[Any, Any]]


@pytest.fixture
def both(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> Both:
    """Calls a function of tensors with them on the device, and again with them on the CPU's kernels."""

    def call(function: Callable[..., Any], *tensors: Tensor) -> tuple[Any, Any]:
        found = function(*(tensor.to(device) for tensor in tensors))
        with monkeypatch.context() as patch:
            patch.setattr(support, "on_gpu", lambda device: False)
            return found, function(*tensors)

    return call


def scenery(margin: int) -> tuple[Tensor, Tensor]:
    """Accumulated depth and alpha: an edge, a floater, holes, and what is no number."""
    height, width = SMALL.height + 2 * margin, SMALL.width + 2 * margin
    depth = torch.full((height, width), 3.0)
    depth[:, width // 2 :] = 1.5
    alpha = torch.linspace(0.4, 1.0, width).repeat(height, 1)
    depth[6, 8:16] = torch.tensor([np.nan, np.inf, 0.0, -1.0, 1e-4, 1e-30, 3e38, 5.0])
    alpha[9, 10:14] = torch.tensor([np.nan, 0.0, 0.5, 1.0])
    return depth, alpha


@pytest.mark.parametrize("margin", [0, 4])
def test_the_fields_are_those_of_the_cpu(both: Both, margin: int) -> None:
    found, expected = both(
        lambda depth, alpha: displacement_fields(ALL, SMALL, depth, alpha, margin, SCALE), *scenery(margin)
    )
    assert found.sweep.std() > 1.0
    for mine, theirs in zip(found[:3], expected[:3], strict=True):
        # Up to 8 px, by some ten float32 operations, whose last bits differ: the worst is 5e-7.
        torch.testing.assert_close(mine.cpu(), theirs, rtol=0.0, atol=1e-5)
    assert enough_samples(found) == enough_samples(expected)


def moved(motion: FrameMotion) -> tuple[DisplacementFields, int]:
    return displacement_fields(motion, SMALL, *scenery(4), 4, SCALE), 4


def placed(fields: DisplacementFields, device: torch.device) -> DisplacementFields:
    return DisplacementFields(*(field.to(device) for field in fields[:3]))


def aside(height: int, width: int) -> tuple[DisplacementFields, int]:
    """One sample between pixels, beyond all borders in places."""
    fields = constant_fields(height, width, 0.0, 0.0)
    fields.offset.copy_(torch.linspace(-3.3, 2.9, fields.offset.numel()).reshape(fields.offset.shape))
    return fields, 0


CASES = {
    "many samples": lambda: moved(ALL),
    "one sample": lambda: moved(ROLLED),
    "two passes": lambda: moved(LONG),
    "longer than the image": lambda: (constant_fields(9, 14, 60.0, 0.0), 0),
    "higher than the image": lambda: (constant_fields(9, 14, 0.0, 60.0, 2.0), 0),
    "one pixel": lambda: (constant_fields(1, 1, 5.0, 5.0, 1.0), 0),
    "one row": lambda: (constant_fields(1, 9, 3.0, 2.0), 0),
    "one column": lambda: (constant_fields(40, 1, 0.0, 7.0, 3.0), 0),
    "one pixel, one sample": lambda: aside(1, 1),
    "one row, one sample": lambda: aside(1, 9),
    "two by two, one sample": lambda: aside(2, 2),
}


@pytest.mark.parametrize("case", CASES)
def test_forward_and_transpose_equal_oracle_and_cpu(case: str, both: Both) -> None:
    fields, margin = CASES[case]()
    warp = Warp.of(fields, margin)
    assert (len(warp.samples) == 1) == ("one sample" in case)
    height, width = fields.radius.shape
    image, light = random_image(height + 2 * margin, width + 2 * margin), random_image(height, width) - 0.5

    def both_ways(image: Tensor, light: Tensor, *fields: Tensor) -> tuple[Tensor, Tensor]:
        warp = Warp.of(DisplacementFields(*fields), margin)
        return warp.forward(image).cpu(), warp.transpose(light).cpu()

    (made, back), (cpu_made, cpu_back) = both(both_ways, image, light, *fields[:3])
    expected = oracle(image[..., :3], warp)
    expected.backward(light[..., :3].double())
    gradient = expected.image.grad
    # Positions of some 40 px in float32 are good to 4e-6 px, and the image changes by at most 1 a pixel; the
    # worst is 1.4e-6. Light piles up at the borders: errors relative to the most that is sent to a place.
    pile = max(1.0, float(gradient.abs().max()))
    assert (made[..., :3] - expected).abs().max() < 6e-6
    assert (made - cpu_made).abs().max() < 6e-6
    assert (back[..., :3] - gradient).abs().max() < 6e-6 * pile
    assert (back - cpu_back)[..., :3].abs().max() < 6e-6 * pile
    assert not back[..., 3].any()
    # The same shares both ways, so that only the sums are rounded: the worst is 5e-9 of the norms.
    assert abs(dot(made, light) - dot(image, back)) < 5e-8 * made.norm() * light.norm()


def test_a_still_frame_is_the_image_itself(device: torch.device) -> None:
    warp = Warp.of(placed(constant_fields(9, 14, 0.0, 0.0), device))
    image = random_image(9, 14).to(device)
    assert torch.equal(warp.forward(image), image)
    # Shares of 2^-54 of the brightest pixel are lost, which is less than float32 keeps of any of these.
    assert torch.equal(warp.transpose(image), image)


def test_the_order_of_the_sums_does_not_matter(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    kernels = importlib.import_module("cleargs.splat.kernels.cuda.frame_warp")
    warp = Warp.of(placed(constant_fields(12, 14, 5.0, 9.0), device))
    light = random_image(12, 14).to(device)
    found = []
    for block in (64, 256):
        monkeypatch.setattr(kernels, "BLOCK", block)
        found.append(warp.transpose(light))
    assert torch.equal(*found)


@pytest.mark.parametrize("size", [0.0, 1e-15, 1e-6, 1e20])
def test_light_of_any_size_comes_back(size: float, device: torch.device) -> None:
    warp = Warp.of(placed(constant_fields(7, 8, 3.0, 1.0), device))
    light = random_image(7, 8).to(device)
    expected = size * warp.transpose(light)
    assert (warp.transpose(size * light) - expected).abs().max() <= 1e-6 * expected.max()


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # NumPy, of the interpreter
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_light_that_is_not_finite_is_not_hidden(value: float, device: torch.device) -> None:
    warp = Warp.of(placed(constant_fields(7, 8, 3.0, 1.0), device))
    light = random_image(7, 8).to(device)
    light[3, 4, 1] = value
    assert warp.transpose(light)[3, 4, 1].isnan()


@pytest.mark.parametrize("curve", [linear_curve, srgb_curve], ids=["to linear light", "to sRGB"])
@pytest.mark.parametrize(("stored", "channels"), [(3, 4), (4, 3)])
def test_curves_are_those_of_the_cpu(
    curve: Callable[[torch.device], Tensor], stored: int, channels: int, both: Both
) -> None:
    values = torch.linspace(-0.2, CURVE_LAST + 0.3, 50 * stored).reshape(5, 10, stored)

    def follow(image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        out, slope = through_curve(image, curve(image.device), channels)
        return out.cpu(), slope.cpu(), times_slope(out, slope, CHANNELS).cpu()

    found, expected = both(follow, values)
    for mine, theirs in zip(found, expected, strict=True):
        # The same operations, but the CPU's may be fused: the worst is the last bit.
        torch.testing.assert_close(mine, theirs, rtol=1e-6, atol=1e-6)
    assert not found[2][..., 3].any()


def test_a_training_through_the_warp_follows_the_cpu(
    device: torch.device, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A blurred, a rolled and a defocused frame, rendered with a margin."""
    monkeypatch.setattr(splat_toy, "WIDTH", 20)
    monkeypatch.setattr(splat_toy, "HEIGHT", 16)
    # How the frames were taken is given: a search would tell near ties apart by the last bit.
    monkeypatch.setattr(CaptureFormation, "_due", lambda self, frame_id: False)
    rng = np.random.default_rng(0)
    views = splat_toy.views([rng.integers(0, 256, (16, 20, 3), dtype=np.uint8) for _ in range(3)])
    depth = {"median_depth": 1.0}
    motions = {
        "blur": FrameMotion(blur=0.3 * ALL.blur, **depth),
        "skew": FrameMotion(skew=ALL.skew, **depth),
        "defocus": FrameMotion(disc_px=1.2, focus=1.4, **depth),
    }
    known = {
        index: FrameFormation(index, motion, model, misfit=0.1, misfit_still=0.2, reach_px=3.0)
        for index, (model, motion) in enumerate(motions.items())
    }
    config = TrainConfig(steps=3, densify=False, coarse_share=0.0, lr_means=2e-3)

    def trained(where: str) -> Trained:
        formation = CaptureFormation(views, FormationConfig(start=0.0), known=known)
        assert [frame.model for frame in formation.frames.values()] == list(motions)
        return train(
            splat_toy.start(6),
            views,
            config,
            seed=(7,),
            formation=formation,
            checkpoint=tmp_path / "state.safetensors",
            reporter=SilentReporter(),
            device=where,
        )

    on_gpu = trained(str(device))
    with monkeypatch.context() as patch:
        patch.setattr(support, "on_gpu", lambda device: False)
        on_cpu = trained("cpu")
    assert sorted(on_cpu.rows.column("frame_id").to_pylist()) == [0, 1, 2]
    for name in ("loss", "l1", "ssim", "psnr"):
        expected = on_cpu.rows.column(name).to_pylist()
        assert on_gpu.rows.column(name).to_pylist() == pytest.approx(expected, rel=1e-5), name
    # The worst is 1e-6, but as in test_gpu_training.py a gradient near 0 may change its sign on a device.
    for name, tensor in on_cpu.scene.gaussians.tensors().items():
        error = (getattr(on_gpu.scene.gaussians, name) - tensor).abs()
        assert (error < 1e-4).double().mean() > 0.97, name
