"""Tiling, ONNX experts and the embedded restoration network."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cleargs.errors import InputError, StageError
from cleargs.models.expert import OnnxExpert, load_expert
from cleargs.models.onnx import OnnxModel
from cleargs.models.registry import model_file
from cleargs.models.tiling import Sides, map_tiled, plan_axis
from tools.train_models.degrade import Degradation, degrade, motion_kernel

Image = NDArray[np.float32]

SIZES = [(1, 1), (7, 300), (64, 64), (65, 255), (256, 257), (540, 960), (513, 700)]


def noise_image(height: int, width: int, seed: int = 0) -> Image:
    return np.random.default_rng(seed).random((height, width, 3), np.float32)


def drawing(height: int, width: int, seed: int = 0) -> Image:
    """Draw crisp overlapping discs and bars on a gradient: edges of all directions and contrasts."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    image = np.stack([0.3 + 0.4 * x / width, 0.4 + 0.2 * y / height, 0.5 - 0.2 * x / width], axis=-1)
    for _ in range(60):
        centre, radius = rng.uniform((0, 0), (width, height)), rng.uniform(4, 30)
        distance = np.hypot(x - centre[0], y - centre[1]) - radius
        if rng.random() < 0.5:
            angle = rng.uniform(0, np.pi)
            across = (x - centre[0]) * np.cos(angle) + (y - centre[1]) * np.sin(angle)
            along = (y - centre[1]) * np.cos(angle) - (x - centre[0]) * np.sin(angle)
            distance = np.maximum(np.abs(across) - radius / 5, np.abs(along) - 2 * radius)
        cover = np.clip(0.5 - distance, 0.0, 1.0)[..., None]
        image = image * (1 - cover) + rng.uniform(0.05, 0.95, 3) * cover
    return image.astype(np.float32)


def apply_tiled(function: Callable[[Image], Image], image: Image, fixed: Sides = (None, None)) -> Image:
    return map_tiled(lambda tiles: map(function, tiles), image, fixed=fixed)


def psnr(image: Image, reference: Image) -> float:
    return float(-10 * np.log10(np.mean(np.square(image.astype(np.float64) - reference)) + 1e-12))


# --- tiles ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fixed", [None, 100, 256])
@pytest.mark.parametrize("length", [1, 63, 64, 65, 100, 101, 256, 511, 512, 513, 960, 1500])
def test_tiles_cover_the_side_and_weights_sum_to_one(length: int, fixed: int | None) -> None:
    axis = plan_axis(length, fixed)
    total = np.zeros(axis.padded)
    for start, window in zip(axis.starts, axis.windows, strict=True):
        assert window.shape == (axis.size,)
        total[start : start + axis.size] += window
    assert axis.padded >= length
    assert fixed is None or axis.size == fixed
    np.testing.assert_allclose(total, 1.0, atol=1e-6)  # a few float32 roundings


@pytest.mark.parametrize("fixed", [(None, None), (256, 256), (100, 140)])
@pytest.mark.parametrize("size", SIZES)
def test_identity_returns_the_image(size: tuple[int, int], fixed: tuple[int | None, int | None]) -> None:
    image = noise_image(*size)
    result = apply_tiled(lambda tile: tile, image, fixed=fixed)
    assert result.shape == image.shape
    np.testing.assert_allclose(result, image, atol=1e-6)  # float32 weights


def test_tiles_keep_their_place() -> None:
    # Each tile is inverted, so a misplaced or transposed tile would be visible.
    image = noise_image(300, 500)
    np.testing.assert_allclose(apply_tiled(lambda t: 1 - t, image, fixed=(96, 128)), 1 - image, atol=1e-6)


def test_free_tiles_have_sides_that_encoders_can_halve() -> None:
    shapes = set()

    def record(tile: Image) -> Image:
        shapes.add(tile.shape)
        return tile

    apply_tiled(record, noise_image(541, 1003))
    assert all(
        height % 64 == 0 and width % 64 == 0 and max(height, width) <= 512 for height, width, _ in shapes
    )


def test_seams_are_smooth() -> None:
    # Tiles with different results (each returns its mean) must be blended with a ramp, not a step.
    image = np.broadcast_to(np.linspace(0, 1, 700, dtype=np.float32)[None, :, None], (64, 700, 3)).copy()
    blended = apply_tiled(lambda tile: np.full_like(tile, tile.mean()), image, fixed=(64, 256))
    means = 256 / 700  # maximum difference between the means of neighbouring tiles
    assert blended.std() > 0.1
    # A raised cosine over the shortest overlap, 32 pixels, rises by at most pi/2 / 32 of it per pixel.
    assert np.abs(np.diff(blended, axis=1)).max() < means * np.pi / 2 / 32 * 1.05


# --- the shipped expert ---------------------------------------------------------------------------------


def test_shipped_model_is_small_and_has_a_stable_digest() -> None:
    path = model_file("embedded", "expert")
    assert path.stat().st_size <= 8_000_000
    expert = load_expert("embedded")
    assert expert.name == "embedded"
    assert len(expert.digest) == 64
    assert expert.digest == OnnxModel(path).digest


def test_threads_do_not_change_a_bit() -> None:
    expert = load_expert("embedded")
    image = drawing(300, 620)
    np.testing.assert_array_equal(expert.restore(image, threads=1), expert.restore(image, threads=2))


@pytest.mark.parametrize("size", [(5, 9), (100, 131)])
def test_any_size(size: tuple[int, int]) -> None:
    restored = load_expert("embedded").restore(noise_image(*size))
    assert restored.shape == (*size, 3)
    assert restored.dtype == np.float32
    assert restored.min() >= 0.0
    assert restored.max() <= 1.0


def test_tiling_is_almost_invisible() -> None:
    # The receptive field is bounded, so results away from tile borders do not depend on the tile.
    image = drawing(192, 704)
    expert = OnnxExpert(model_file("embedded", "expert"))
    whole = expert._restore(image[None])[0]
    assert psnr(expert.restore(image), np.clip(whole, 0, 1)) > 50


def test_sharp_images_change_little() -> None:
    image = drawing(256, 256)
    # 38 dB is the target for photographs.
    assert psnr(load_expert("embedded").restore(image), image) > 38


@pytest.mark.parametrize("length", [9.0, 14.0, 19.0])
def test_motion_blur_is_reduced(length: float) -> None:
    expert = load_expert("embedded")
    inner = (slice(24, -24), slice(24, -24))
    gains = []
    for seed in range(3):
        sharp = drawing(256, 256, seed)
        rng = np.random.default_rng([77, seed])
        blurred = degrade(sharp, Degradation(kernel=motion_kernel(rng, length), noise=0.5 / 255), rng)
        restored = expert.restore(blurred)
        gains.append(psnr(restored[inner], sharp[inner]) - psnr(blurred[inner], sharp[inner]))
    # Drawings differ from the training photographs. Measured means: 0.67, 0.56 and 0.37 dB.
    assert min(gains) > 0.0
    assert np.mean(gains) > 0.2


# --- other models and errors ----------------------------------------------------------------------------


def test_missing_file() -> None:
    with pytest.raises(InputError, match="No such file") as caught:
        load_expert("no/such/model.onnx")
    with pytest.raises(InputError, match="there is no expert 'embeded'") as error:
        model_file("embeded", "expert")
    assert error.value.hint == "did you mean embedded?"
    assert caught.value.hint


def test_a_file_that_is_not_a_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.onnx"
    path.write_bytes(b"not a model")
    with pytest.raises(InputError, match="not an ONNX model"):
        load_expert(str(path))


def test_values_that_are_not_finite_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    expert = OnnxExpert(model_file("embedded", "expert"))
    output = np.full((1, 3, 64, 64), np.nan, np.float32)
    monkeypatch.setattr(expert._model, "run", lambda *_: [output])
    with pytest.raises(StageError, match="not finite"):
        expert.restore(noise_image(64, 64))


def test_a_model_that_changes_the_size_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    expert = OnnxExpert(model_file("embedded", "expert"))
    output = np.zeros((1, 3, 128, 128), np.float32)
    monkeypatch.setattr(expert._model, "run", lambda *_: [output])
    with pytest.raises(InputError, match="maps"):
        expert.restore(noise_image(64, 64))
