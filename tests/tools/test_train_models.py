"""Degradations, artefacts, pairs, and short trainings of the networks in the package."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from cleargs.media.colour import linear_from_srgb
from cleargs.models.lpips import LpipsNetwork
from tools.train_models import artefacts
from tools.train_models.degrade import Degradation, degrade, disc_kernel, jpeg, motion_kernel
from tools.train_models.naturalness import fit
from tools.train_models.scorer_pairs import KIND_NAMES, PATCH, load_pairs, make_pairs
from tools.train_models.train_scorer import QualityNet, predict, train

Image = NDArray[np.float32]


def noise_image(height: int, width: int, seed: int = 0) -> Image:
    return np.random.default_rng(seed).random((height, width, 3), np.float32)


def coloured_texture(height: int, width: int, seed: int = 0) -> Image:
    """Return noise of several scales, in [0, 1]."""
    rng = np.random.default_rng(seed)
    scales = [rng.random((-(-height // s), -(-width // s), 3), np.float32) for s in (2, 8, 32)]
    layers = [cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC) for noise in scales]
    return np.clip(np.mean(layers, axis=0), 0, 1).astype(np.float32)


@pytest.fixture(scope="module")
def texture() -> Image:
    return coloured_texture(200, 320)


def psnr(image: Image, reference: Image) -> float:
    return float(-10 * np.log10(np.mean(np.square(image.astype(np.float64) - reference)) + 1e-12))


# --- degradations ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [0.5, 3.0, 7.0, 14.0, 21.0])
def test_motion_kernels(length: float) -> None:
    for seed in range(20):
        kernel = motion_kernel(np.random.default_rng(seed), length)
        assert kernel.shape[0] == kernel.shape[1]
        assert kernel.shape[0] % 2 == 1
        assert kernel.min() >= 0
        assert kernel.sum() == pytest.approx(1.0, abs=1e-5)
        y, x = np.mgrid[: kernel.shape[0], : kernel.shape[0]] - kernel.shape[0] // 2
        # The centre of mass is at the centre, so that blur does not shift the image.
        assert np.hypot((kernel * x).sum(), (kernel * y).sum()) < 1e-3
        points = np.argwhere(kernel > 1e-6)
        extent = np.linalg.norm(points[:, None] - points[None], axis=-1).max()
        # Bilinear splatting widens a path by less than the diagonal of a pixel at each end.
        assert length - 1 <= extent <= length + 2 * np.sqrt(2)


def test_kernels_depend_only_on_the_seed() -> None:
    first, again, other = (motion_kernel(np.random.default_rng(seed), 15.0) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_disc_kernel() -> None:
    kernel = disc_kernel(3.0)
    assert kernel.sum() == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(kernel, kernel.T, atol=1e-7)
    assert kernel[3, 3] == 0 or kernel.shape[0] > 7  # nothing outside the disc is cut off


def test_blur_keeps_light() -> None:
    # No light of a bright window reaches the border, so the linear mean is kept; that of sRGB is not.
    image = np.full((96, 96, 3), 0.05, np.float32)
    image[40:56, 40:56] = 0.9
    kernel = motion_kernel(np.random.default_rng(1), 15.0)
    blurred = degrade(image, Degradation(kernel=kernel, quantise=False), np.random.default_rng(2))
    light = linear_from_srgb(image).mean(dtype=np.float64)
    assert linear_from_srgb(blurred).mean(dtype=np.float64) == pytest.approx(light, rel=1e-4)
    assert blurred.mean() > image.mean() * 1.05


def test_degradation_is_seeded_and_quantised() -> None:
    image = coloured_texture(64, 64)
    degradation = Degradation(noise=1 / 255)
    first, again, other = (degrade(image, degradation, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    np.testing.assert_allclose(first * 255, np.round(first * 255), atol=1e-3)
    # One code value of noise plus rounding (1/12): the deviation is sqrt(1 + 2/12) code values at most.
    assert 0.9 < (first - image).std() * 255 < 1.2


def test_varying_blur_blends_two_kernels() -> None:
    image = noise_image(64, 64)
    kernel = disc_kernel(3.0)
    out = degrade(image, Degradation(second=kernel, quantise=False), np.random.default_rng(0))
    error = np.abs(out - image).mean(axis=(0, 2))
    assert error[:4].mean() < 0.2 * error[-4:].mean()


def test_jpeg_changes_the_image_slightly() -> None:
    image = coloured_texture(64, 64)
    coded = jpeg(image, 90)
    assert coded.shape == image.shape
    assert 28 < psnr(coded, image) < 60


# --- artefacts


@pytest.mark.parametrize("kind", KIND_NAMES)
def test_artefacts_are_seeded_images(texture: Image, kind: str) -> None:
    patch = texture[:96, :96]
    made = [artefacts.KINDS[kind](patch, np.random.default_rng(7)) for _ in range(2)]
    assert np.array_equal(*made)
    assert made[0].shape == patch.shape and made[0].dtype == np.float32
    assert made[0].min() >= 0.0 and made[0].max() <= 1.0
    assert np.array_equal(made[0], patch) == (kind == "clean")


def test_fuse_equals_the_fused_candidate(texture: Image) -> None:
    soft = cv2.GaussianBlur(texture, (0, 0), 2.0)
    expected = np.clip(soft + texture - cv2.GaussianBlur(texture, (0, 0), 2.0), 0, 1)
    assert np.abs(artefacts.fuse(soft, texture, 2.0) - expected).max() < 1e-5


def test_wiener_undoes_a_known_blur(texture: Image) -> None:
    kernel = disc_kernel(1.5)
    grey = np.repeat(texture.mean(axis=2, keepdims=True), 3, axis=2)
    blurred = cv2.filter2D(grey, -1, kernel, borderType=cv2.BORDER_REFLECT)
    back = artefacts.wiener(blurred, kernel, 1e-4)
    assert np.abs(back - grey).mean() < 0.3 * np.abs(blurred - grey).mean()


def test_ghost_shifts_the_second_exposure() -> None:
    image = np.zeros((40, 60, 3), np.float32)
    image[20, 30] = 1.0
    seen = artefacts.ghost(image, 5.0, -3.0, 0.25)
    assert set(zip(*np.nonzero(seen[..., 0]), strict=True)) == {(20, 30), (17, 35)}
    assert seen[20, 30, 0] > seen[17, 35, 0] > 0.0


def test_motion_kernel_is_shared_with_the_restorer() -> None:
    assert motion_kernel(np.random.default_rng(0), 9.0).sum() == pytest.approx(1.0, abs=1e-5)


# --- training


def test_ridge_fit_finds_a_quadratic() -> None:
    rng = np.random.default_rng(0)
    figures = rng.standard_normal((400, 4, 3))
    truth = 0.3 * figures[..., 0] - 0.2 * figures[..., 1] * figures[..., 2] + 0.1
    model = fit(figures, truth.astype(np.float32))
    found = np.apply_along_axis(model, -1, figures)
    # The ridge shrinks weights slightly, and features are clipped at four deviations.
    assert np.abs(found - truth).mean() < 0.05 * np.abs(truth).mean()


@pytest.fixture(scope="module")
def pairs_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pairs")
    torch.manual_seed(0)
    photos = []
    for seed in range(2):
        photos.append(folder / f"texture_{seed}.png")
        cv2.imwrite(str(photos[-1]), (coloured_texture(240, 320, seed)[..., ::-1] * 255).astype(np.uint8))
    network = LpipsNetwork("alex").eval()  # random weights are enough here: they give some distance
    for head in network.heads.parameters():
        head.data.abs_()
    make_pairs(photos, network, folder / "train", contents=4, versions=4, seed=0)
    return folder


def test_pairs(pairs_folder: Path) -> None:
    pairs = load_pairs(pairs_folder / "train")
    assert pairs.images.shape == (8, 4, PATCH, PATCH, 3)
    assert (pairs.targets[:, 0] == 0.0).all() and (pairs.kinds[:, 0] == 0).all()
    assert (pairs.targets[:, 1:] > 0.0).all() and (pairs.kinds[:, 1:] > 0).all()
    assert len({image.tobytes() for image in pairs.images[:, 0]}) == 8  # all contents differ


def test_training_is_reproducible_and_changes_weights(pairs_folder: Path, tmp_path: Path) -> None:
    pairs = load_pairs(pairs_folder / "train")
    nets = [train(pairs, seconds=600.0, epochs=2, seed=3, checkpoint=tmp_path / "net.pt") for _ in range(2)]
    first, second = (predict(net, pairs) for net in nets)
    assert first.shape == pairs.targets.shape and (first >= 0.0).all()
    # The learning rate depends on time only if the time limit comes first.
    assert np.allclose(first, second, atol=1e-3)
    untrained = QualityNet().eval()
    assert not np.allclose(first, predict(untrained, pairs), atol=1e-4)
    saved = torch.load(tmp_path / "net.pt", weights_only=True)
    assert torch.equal(saved["head.1.weight"], nets[1].state_dict()["head.1.weight"])
