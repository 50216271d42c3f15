"""The statistics evaluator on images of known degradation: blur in linear light, noise, wrong exposure."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from cleargs.progress import SilentReporter
from cleargs.rva import statistics
from cleargs.rva.allocation import appearance_scores
from cleargs.rva.evaluator import EvaluatedFrame
from cleargs.rva.measures import (
    Luminance,
    blocking,
    blur_sigmas,
    detail_ratios,
    noise_level,
    reduce_luminance,
)
from cleargs.rva.statistics import StatisticsEvaluator, cues_from_measures, measure
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.stages.rva import RvaConfig

Linear = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

SIZE = 240, 320


@pytest.fixture(scope="module")
def scene() -> Linear:
    """Linear light [240, 320]: overlapping polygons with sharp, anti-aliased borders."""
    rng = np.random.default_rng(2)
    canvas = np.full((4 * SIZE[0], 4 * SIZE[1]), 0.3, dtype=np.float32)
    for _ in range(160):
        corners = rng.uniform(0, [4 * SIZE[1], 4 * SIZE[0]]) + rng.normal(0, 70, (5, 2))
        cv2.fillConvexPoly(canvas, cv2.convexHull(corners.astype(np.int32)), float(rng.uniform(0.05, 0.7)))
    return cv2.resize(canvas, SIZE[::-1], interpolation=cv2.INTER_AREA).astype(np.float64)


def srgb_image(linear: Linear, noise: float = 0.7) -> Image:
    """8-bit sRGB [h, w, 3] with white noise of ``noise`` levels."""
    srgb = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    )
    levels = 255.0 * srgb + np.random.default_rng(7).normal(0.0, noise, linear.shape)
    return np.repeat(np.clip(np.rint(levels), 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def motion_blurred(linear: Linear, length: int, *, vertical: bool = False) -> Linear:
    """Box blur of ``length`` px along the rows, or along the columns."""
    kernel = np.full((length, 1) if vertical else (1, length), 1.0 / length)
    return np.asarray(cv2.filter2D(linear, -1, kernel, borderType=cv2.BORDER_REFLECT))


def defocused(linear: Linear, sigma: float) -> Linear:
    return np.asarray(cv2.GaussianBlur(linear, (0, 0), sigma))


def cues_of(images: list[Image]) -> dict[str, npt.NDArray[np.float64]]:
    """Cues and scores of a video made of these images."""
    rows = np.stack([measure(reduce_luminance(image, None)) for image in images])
    cues = cues_from_measures(rows)
    R, B = appearance_scores(cues, RvaConfig())
    return {**{name: cues[:, k] for k, name in enumerate(CUE_COLUMNS)}, "R": R, "B": B}


def between_sharp(scene: Linear, worse: list[Image]) -> dict[str, npt.NDArray[np.float64]]:
    """Cues of the images in ``worse``, each between two sharp frames of the same content."""
    sharp = srgb_image(scene)
    images = [sharp]
    for image in worse:
        images += [image, sharp]
    return {name: values[1::2] for name, values in cues_of(images).items()}


def sigmas_of(scene: Linear, image: Image, noise: float = 0.7) -> npt.NDArray[np.float64]:
    """Extents of the blur in ``image``, the sharp scene being known."""
    ratio, content = (
        detail_ratios(view.reduced, view.valid, noise)
        for view in (reduce_luminance(image, None), reduce_luminance(srgb_image(scene), None))
    )
    return blur_sigmas(ratio, content)


@pytest.mark.parametrize("vertical", [False, True])
def test_sigmas_give_direction_and_length_of_a_motion(scene: Linear, vertical: bool) -> None:
    sigmas = sigmas_of(scene, srgb_image(motion_blurred(scene, 7, vertical=vertical)))
    along, across = (4, 0) if vertical else (0, 4)
    assert sigmas.argmax() == along
    # A box of 7 px has a standard deviation of 2.0 px. The measure is 0.7 of it here: a box keeps more fine
    # detail than a Gaussian, and detail across the motion also counts in a tile.
    assert 0.6 < sigmas[along] / (7 / 12**0.5) < 1.0
    # Oblique edges are also wider across the motion (the aperture problem), less so the steeper they are.
    assert sigmas[across] < 0.6 * sigmas[along]


@pytest.mark.parametrize("sigma", [0.7, 1.5, 2.5])
def test_sigma_of_a_gaussian_blur(scene: Linear, sigma: float) -> None:
    # The blur is in linear light, the measure in sRGB, where bright sides of edges spread: at most 15 % here.
    assert sigmas_of(scene, srgb_image(defocused(scene, sigma))) == pytest.approx(np.full(8, sigma), rel=0.2)


def test_contrast_does_not_count_as_sharpness(scene: Linear) -> None:
    blurred = srgb_image(motion_blurred(scene, 7), noise=0.0)
    faint = np.rint(60.0 + 0.5 * blurred).astype(np.uint8)
    # Rounding is noise of 0.3 levels. Some tiles of the faint image have too little structure to be measured.
    assert sigmas_of(scene, faint, 0.3) == pytest.approx(sigmas_of(scene, blurred, 0.3), abs=0.15)


def test_a_sharp_patch_does_not_excuse_a_blurred_frame(scene: Linear) -> None:
    patch = motion_blurred(scene, 9)
    patch[80:160, 120:200] = scene[80:160, 120:200]
    sigmas, throughout = (sigmas_of(scene, srgb_image(image)) for image in (patch, motion_blurred(scene, 9)))
    # The patch is a twelfth of the frame.
    assert sigmas.max() > 0.7 * throughout.max()


def test_longer_motion_is_worse(scene: Linear) -> None:
    cues = between_sharp(scene, [srgb_image(motion_blurred(scene, length)) for length in (1, 3, 6, 12, 20)])
    assert (np.diff(cues["R"]) < 0.0).all()
    assert (np.diff(cues["B"]) > 0.0).all()
    assert (np.diff(cues["b_motion_blur"]) >= 0.0).all()
    assert cues["R"][0] > 0.9
    assert cues["R"][3] < 0.70  # 12 px at 320 px wide is not strong
    assert (cues["b_motion_blur"][2:] > cues["b_defocus"][2:]).all()


def test_stronger_defocus_is_worse_and_is_not_motion(scene: Linear) -> None:
    cues = between_sharp(scene, [srgb_image(defocused(scene, sigma)) for sigma in (0.5, 1.0, 2.0, 3.0)])
    assert (np.diff(cues["R"]) < 0.0).all()
    assert (np.diff(cues["b_defocus"]) > 0.0).all()
    assert (cues["b_defocus"][2:] > cues["b_motion_blur"][2:]).all()


def test_neighbours_do_not_excuse_a_video_blurred_throughout(scene: Linear) -> None:
    cues = cues_of([srgb_image(motion_blurred(scene, 12))] * 6)
    assert (cues["R"] < 0.70).all()


def test_exposure(scene: Linear) -> None:
    cues = between_sharp(scene, [srgb_image(np.clip(scene * 2.0**stops, 0, 1)) for stops in (-5, 0, 2.5)])
    dark, right, glaring = cues["b_exposure_failure"]
    assert right == 0.0
    assert dark > 0.5
    assert glaring > 0.5
    assert cues["r_exposure"][1] == 1.0


def test_noise_is_measured_and_lowers_cleanness(scene: Linear) -> None:
    levels = [0.7, 3.0, 8.0]
    images = [srgb_image(scene, noise) for noise in levels]
    for image, level in zip(images, levels, strict=True):
        luminance = reduce_luminance(image, None)
        # Rounding to 8 bits adds 0.29 levels. A median of quantised values has steps of a quarter level.
        assert noise_level(luminance.reduced, luminance.valid) == pytest.approx(
            level, abs=0.35 + 0.05 * level
        )
    assert (np.diff(cues_of(images)["r_cleanness"]) < 0.0).all()


def test_ghosting(scene: Linear) -> None:
    double = 0.5 * scene + 0.5 * np.roll(scene, (9, 14), axis=(0, 1))
    ghost, sharp = between_sharp(scene, [srgb_image(double), srgb_image(scene)])["b_ghosting"]
    assert ghost > 0.5
    assert sharp == 0.0


def test_blocks_are_artifacts(scene: Linear) -> None:
    clean = srgb_image(scene)
    coded = cv2.imdecode(cv2.imencode(".jpg", clean, [cv2.IMWRITE_JPEG_QUALITY, 8])[1], cv2.IMREAD_COLOR)
    assert blocking(reduce_luminance(coded, None).full) > 3.0 + blocking(reduce_luminance(clean, None).full)
    artifacts = cues_of([coded, clean])["b_artifacts"]
    assert artifacts[0] > artifacts[1] + 0.3


def test_masked_pixels_do_not_count(scene: Linear) -> None:
    sharp, blurred = srgb_image(scene), srgb_image(motion_blurred(scene, 15))
    half = sharp.copy()
    half[:, :160] = blurred[:, :160]
    mask = np.full(SIZE, 255, dtype=np.uint8)
    mask[:, :160] = 0
    shown = reduce_luminance(half, mask)
    hidden = reduce_luminance(sharp, mask)
    # Measured pixels are farther from the mask than the filters reach, so masked pixels have no effect.
    np.testing.assert_array_equal(
        detail_ratios(shown.reduced, shown.valid, noise=0.7),
        detail_ratios(hidden.reduced, hidden.valid, noise=0.7),
    )


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_frame_without_structure_is_not_reliable(level: int) -> None:
    cues = cues_of([np.full((*SIZE, 3), level, dtype=np.uint8)] * 3)
    assert np.isfinite(cues["R"]).all()
    assert (cues["R"] < 0.35).all()


@pytest.mark.parametrize("size", [(1, 1), (5, 400), (40, 40)])
def test_tiny_images_are_judged_without_an_error(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    for values in cues_of([image]).values():
        assert ((values >= 0.0) & (values <= 1.0)).all()


def test_added_frames_are_the_only_ones_measured(
    scene: Linear, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = []
    for k, length in enumerate([1, 9, 5]):
        path = tmp_path / f"{k}.png"
        cv2.imwrite(str(path), srgb_image(motion_blurred(scene, length)))
        views.append(EvaluatedFrame(k, path))
    measured: list[Luminance] = []

    def counting(luminance: Luminance) -> npt.NDArray[np.float64]:
        measured.append(luminance)
        return measure(luminance)

    monkeypatch.setattr(statistics, "measure", counting)
    kept = tmp_path / "kept"

    def evaluate(views: list[EvaluatedFrame]) -> npt.NDArray[np.float64]:
        return StatisticsEvaluator(kept).evaluate(views, threads=1, reporter=SilentReporter())

    evaluate(views[:2])
    assert len(measured) == 2
    grown = evaluate(views)
    assert len(measured) == 3
    fresh = StatisticsEvaluator().evaluate(views, threads=1, reporter=SilentReporter())
    np.testing.assert_array_equal(grown, fresh)

    # The key of the cache includes the bytes of image and mask. A damaged file is replaced.
    measured.clear()
    mask = tmp_path / "mask.png"
    cv2.imwrite(str(mask), np.full(SIZE, 255, dtype=np.uint8))
    evaluate([EvaluatedFrame(0, views[0].image, mask), *views[1:]])
    assert len(measured) == 1
    for file in kept.iterdir():
        file.write_text(file.read_text()[:40])
    np.testing.assert_array_equal(evaluate(views), fresh)


def test_threads_can_cache_equal_frames_at_once(scene: Linear, tmp_path: Path) -> None:
    path = tmp_path / "still.png"
    cv2.imwrite(str(path), srgb_image(scene))
    views = [EvaluatedFrame(k, path) for k in range(16)]
    cues = StatisticsEvaluator(tmp_path / "kept").evaluate(views, threads=8, reporter=SilentReporter())
    assert (cues == cues[0]).all()


def test_threads_do_not_change_the_cues(scene: Linear, tmp_path: Path) -> None:
    views = []
    for k, length in enumerate([1, 9, 1, 5, 3, 14]):
        path = tmp_path / f"{k}.png"
        cv2.imwrite(str(path), srgb_image(motion_blurred(scene, length)))
        views.append(EvaluatedFrame(k, path))
    one, four = (StatisticsEvaluator().evaluate(views, threads=n, reporter=SilentReporter()) for n in (1, 4))
    np.testing.assert_array_equal(one, four)
    assert one.shape == (6, 11)
    assert ((one >= 0.0) & (one <= 1.0)).all()
