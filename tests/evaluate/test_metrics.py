"""PSNR and SSIM against torchmetrics, masks, LPIPS and scorers that are or are not installed."""

from __future__ import annotations

import importlib
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file

from cleargs.errors import InputError
from cleargs.evaluate.config import EvalOptions
from cleargs.evaluate.metrics import load_metrics, psnr, ssim
from cleargs.models.lpips import LpipsNetwork, weights_file


def pair(height: int = 61, width: int = 83) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A smooth picture, and the same blurred with noise on it."""
    rng = np.random.default_rng(0)
    smooth = cv2.GaussianBlur(rng.uniform(0, 255, (height, width, 3)), (0, 0), 1.5)
    smooth = (smooth - smooth.min()) / np.ptp(smooth) * 255
    other = cv2.GaussianBlur(smooth, (0, 0), 1.0) + rng.normal(0, 6, smooth.shape)
    return smooth.astype(np.uint8), other.clip(0, 255).astype(np.uint8)


def test_psnr_and_ssim_equal_those_of_torchmetrics() -> None:
    try:
        image_metrics = importlib.import_module("torchmetrics.functional.image")
    except Exception as error:  # it imports torchvision, whose build for another torch raises RuntimeError
        pytest.skip(f"torchmetrics cannot be imported: {error}")
    a, b = pair()
    planes = [torch.from_numpy(x).permute(2, 0, 1)[None].double() / 255 for x in (a, b)]
    expected = image_metrics.structural_similarity_index_measure(*planes, data_range=1.0)
    found = ssim(a, b)
    assert found is not None and 0.3 < found < 0.95  # a figure that means something
    # Both in float64; torchmetrics takes its Gaussian window in float64 too.
    assert found == pytest.approx(expected.item(), abs=1e-9)
    noise = image_metrics.peak_signal_noise_ratio(*planes, data_range=1.0)
    # torchmetrics keeps the data range in float32.
    assert psnr(a, b) == pytest.approx(noise.item(), abs=1e-5)


def test_equal_images() -> None:
    a, _ = pair()
    assert psnr(a, a) == math.inf
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-12)


def test_masked_pixels_count_for_nothing() -> None:
    a, b = pair()
    mask = np.ones(a.shape[:2], bool)
    mask[20:30, 40:60] = False
    damaged = b.copy()
    damaged[~mask] = 255
    assert psnr(damaged, a, mask) == psnr(b, a, mask) != psnr(b, a)
    assert ssim(damaged, a, mask) == ssim(b, a, mask)
    assert psnr(a, b, np.ones_like(mask)) == psnr(a, b) and ssim(a, b, np.ones_like(mask)) == ssim(a, b)


def test_nothing_left_by_the_mask() -> None:
    a, b = pair()
    nothing = np.zeros(a.shape[:2], bool)
    assert psnr(a, b, nothing) is None and ssim(a, b, nothing) is None
    nothing[5, 5] = True  # a pixel, but no whole window
    assert psnr(a, b, nothing) is not None and ssim(a, b, nothing) is None


def test_what_is_not_installed_is_null_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLEARGS_MODELS", str(tmp_path))
    options = EvalOptions()
    metrics = load_metrics(options)
    a, b = pair()
    values = metrics.measure(a, b, None)
    assert set(values) == set(options.metrics)
    for metric in ("lpips_alex", "lpips_vgg"):
        assert values[metric] is None and "cleargs models install lpips" in metrics.unavailable[metric]
    # The two that ship with ClearGS are always there.
    for metric in ("clarity-net", "naturalness-stats"):
        assert values[metric] is not None and len(metrics.weights[metric]) == 64
    assert set(metrics.weights) | set(metrics.unavailable) == set(options.metrics) - {"psnr", "ssim"}


def test_lpips_where_it_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLEARGS_MODELS", str(tmp_path))
    torch.manual_seed(0)
    network = LpipsNetwork("alex")
    for head in network.heads:
        head.get_parameter("weight").data.abs_()
    save_file(network.state_dict(), tmp_path / weights_file("alex"))
    metrics = load_metrics(EvalOptions(lpips=("alex",), scorers=()))
    a, b = pair(height=80)
    assert metrics.measure(a, a, None)["lpips_alex"] == 0.0
    whole = metrics.measure(b, a, None)["lpips_alex"]
    mask = np.zeros(a.shape[:2], bool)
    assert whole is not None and whole > 0.0
    assert metrics.measure(b, a, mask)["lpips_alex"] == 0.0  # nothing but the reference is left to see
    (tmp_path / weights_file("alex")).write_bytes(b"damaged")
    with pytest.raises(InputError, match="does not hold"):
        load_metrics(EvalOptions(lpips=("alex",), scorers=()))


def test_a_scorer_nobody_knows() -> None:
    with pytest.raises(InputError, match="bestnet"):
        load_metrics(EvalOptions(lpips=(), scorers=("bestnet",)))
