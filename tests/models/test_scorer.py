"""No-reference scorers and their tiles."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cleargs.errors import InputError
from cleargs.models.naturalness import Quadratic, StatisticsScorer, expected_value, features, terms
from cleargs.models.scorer import (
    CLARITY,
    NATURALNESS,
    InformedScorer,
    LearnedScorer,
    Scorer,
    information,
    load_scorer,
)
from cleargs.models.tiling import mean_over_tiles
from tools.train_models import artefacts

Image = NDArray[np.float32]


def dead_leaves(seed: int, height: int = 200, width: int = 320) -> Image:
    """Draw opaque discs of all sizes with fine textures, a standard model of natural images."""
    rng = np.random.default_rng(seed)
    scale = 3  # the image is drawn larger and reduced, so that its edges are as soft as those of a camera
    canvas = np.full((scale * height, scale * width, 3), 0.5, np.float32)
    texture = cv2.GaussianBlur(rng.standard_normal(canvas.shape[:2], np.float32), (0, 0), 2.0)
    texture /= texture.std()
    for _ in range(900):
        radius = int(scale * 3.0 * (1.0 - rng.random()) ** -0.6)
        centre = (int(rng.integers(0, canvas.shape[1])), int(rng.integers(0, canvas.shape[0])))
        mask = np.zeros(canvas.shape[:2], np.uint8)
        cv2.circle(mask, centre, min(radius, 300), 1, -1)
        inside = mask.astype(bool)
        canvas[inside] = rng.random(3) * 0.8 + 0.1 + (rng.uniform(0.0, 0.06) * texture[inside])[:, None]
    reduced = cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)
    return np.clip(reduced, 0.0, 1.0).astype(np.float32)


@pytest.fixture(scope="module")
def leaves() -> Image:
    return dead_leaves(0)


@pytest.fixture(scope="module", params=[CLARITY, NATURALNESS])
def scorer(request: pytest.FixtureRequest) -> Scorer:
    return load_scorer(request.param)


def test_degradations_lower_the_score(scorer: Scorer, leaves: Image) -> None:
    rng = np.random.default_rng(5)
    clean = scorer.score(leaves)
    blurred = cv2.GaussianBlur(leaves, (0, 0), 2.5)
    faulty = {
        "blur": blurred,
        "noise": np.clip(leaves + 0.1 * rng.standard_normal(leaves.shape, np.float32), 0, 1),
        "splats": artefacts.splat(leaves, rng, spacing=5.0, stretch=4.0),
    }
    # RIVR uses the second scorer for differences below one point; these degradations cost much more.
    for name, image in faulty.items():
        assert scorer.score(image) < clean - 3.0, name


def test_more_blur_scores_lower(scorer: Scorer, leaves: Image) -> None:
    scores = [scorer.score(cv2.GaussianBlur(leaves, (0, 0), sigma)) for sigma in (0.8, 1.6, 3.2)]
    assert scores == sorted(scores, reverse=True)


def test_same_bits_for_any_thread_count(scorer: Scorer, leaves: Image) -> None:
    assert scorer.score(leaves, threads=1) == scorer.score(leaves, threads=3)
    assert load_scorer(scorer.name).score(leaves) == scorer.score(leaves)


def test_names_and_digests(scorer: Scorer) -> None:
    assert scorer.name in (CLARITY, NATURALNESS)
    assert len(scorer.digest) == 64
    assert load_scorer(CLARITY).digest != load_scorer(NATURALNESS).digest


def test_the_score_depends_little_on_the_image_size(scorer: Scorer, leaves: Image) -> None:
    """Four copies side by side have the same texture, except at the seams."""
    mirrored = np.concatenate([leaves, leaves[:, ::-1]], axis=1)
    mirrored = np.concatenate([mirrored, mirrored[::-1]], axis=0)
    assert scorer.score(mirrored) == pytest.approx(scorer.score(leaves), abs=2.0)


@pytest.mark.parametrize("height, width", [(32, 32), (33, 130), (129, 47)])
def test_small_and_odd_sizes(scorer: Scorer, leaves: Image, height: int, width: int) -> None:
    assert np.isfinite(scorer.score(leaves[:height, :width]))


@pytest.mark.parametrize("value", [0.0, 0.2, 0.5, 1.0])
def test_flat_images_score_near_zero(scorer: Scorer, value: float) -> None:
    """Without the factor, clarity-net gave black 96.5 and the statistics gave it 103."""
    assert scorer.score(np.full((64, 96, 3), value, np.float32)) == 0.0
    rounded = np.round(value * 255 + np.random.default_rng(0).uniform(-0.49, 0.49, (64, 96, 3))) / 255
    assert scorer.score(np.clip(rounded, 0, 1).astype(np.float32)) < 5.0


def test_a_frame_half_black_has_half_its_score(scorer: Scorer, leaves: Image) -> None:
    half = leaves[:192].copy()
    half[:, :160] = 0.0
    # The edge is at a border of blocks (16 px), so only the scorer's rating of the black half differs.
    assert scorer.score(half) == pytest.approx(0.5 * scorer.score(leaves[:192]), abs=5.0)


@pytest.mark.parametrize("gain", [1.5, 2.0, 3.0, 8.0])
def test_clipping_lowers_the_score(scorer: Scorer, leaves: Image, gain: float) -> None:
    """Without the factor, the statistics rated overexposed real frames up to 11 points higher."""
    clipped = np.clip(leaves * np.float32(gain), 0, 1)
    assert scorer.score(clipped) < scorer.score(leaves)


def test_information_is_one_for_frames_and_continuous(leaves: Image) -> None:
    assert information(leaves) == 1.0
    faded = [
        information((leaves * np.float32(w)) + np.float32(0.5 * (1 - w))) for w in np.linspace(0, 0.1, 41)
    ]
    assert faded[0] == 0.0 and faded[-1] > 0.5
    assert np.diff(faded).min() >= 0.0 and np.diff(faded).max() < 0.25
    exposed = [information(np.clip(leaves * np.float32(g), 0, 1)) for g in np.linspace(1, 3, 201)]
    assert exposed[-1] < 0.6
    assert np.abs(np.diff(exposed)).max() < 0.1  # gains of 1 %; many discs have the same colour


def images() -> st.SearchStrategy[Image]:
    """Generate noise of any mean, strength and grain size, clipped to [0, 1]."""

    def make(seed: int, mean: float, strength: float, cell: int) -> Image:
        noise = np.random.default_rng(seed).standard_normal((64, 96, 3), np.float32)[::cell, ::cell]
        drawn = cv2.resize(mean + strength * noise, (96, 64), interpolation=cv2.INTER_CUBIC)
        return np.clip(drawn, 0, 1).astype(np.float32)

    unit = st.floats(0, 1)
    return st.builds(make, st.integers(0, 99), unit, unit, st.sampled_from([1, 2, 4, 16]))


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(image=images())
def test_scores_are_in_range(scorer: Scorer, image: Image) -> None:
    assert 0.0 <= scorer.score(image) <= 100.0


@given(a=st.floats(-3, 3), b=st.floats(-3, 3))
def test_expected_value_is_in_range_and_monotonic(a: float, b: float) -> None:
    low, high = expected_value(min(a, b)), expected_value(max(a, b))
    assert -1e-12 <= low <= high <= 1.0 + 1e-12
    if -0.2 <= min(a, b) < max(a, b) - 1e-3 and max(a, b) <= 1.2:
        assert low < high  # no saturation in the range of predictions


def test_scores_of_any_scorer_are_clipped(leaves: Image) -> None:
    class Fixed:
        name, digest = "fixed", "none"

        def __init__(self, value: float) -> None:
            self.value = value

        def score(self, image: Image, *, threads: int = 1) -> float:
            return self.value

    assert [InformedScorer(Fixed(value)).score(leaves) for value in (-3.0, 40.0, 107.0)] == [0.0, 40.0, 100.0]
    with pytest.raises(InputError, match="fixed returned nan"):
        InformedScorer(Fixed(np.nan)).score(leaves)


@pytest.mark.parametrize("shape", [(64, 64), (31, 64, 3), (64, 64, 4)])
def test_refuses_other_shapes(scorer: Scorer, shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="cannot be scored"):
        scorer.score(np.zeros(shape, np.float32))


@pytest.mark.parametrize(
    ("image", "cause"),
    [
        (np.full((64, 64, 3), 128, np.uint8), "uint8 values"),  # once had a wrong score
        (np.full((64, 64, 3), 0.5), "float64 values"),
        (np.full((64, 64, 3), 128, np.float32), "from 128 to 128"),
        (np.full((64, 64, 3), -0.5, np.float32), "from -0.5 to -0.5"),
        (np.full((64, 64, 3), np.nan, np.float32), "from nan to nan"),
        (np.full((64, 64, 3), np.inf, np.float32), "from inf to inf"),
    ],
)
def test_refuses_other_values(scorer: Scorer, image: np.ndarray, cause: str) -> None:
    with pytest.raises(InputError, match=cause) as caught:
        scorer.score(image)
    assert "[0, 1]" in caught.value.hint


def test_unknown_scorers(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="musik") as caught:
        load_scorer("musik")
    assert caught.value.hint == "did you mean musiq?"
    with pytest.raises(InputError, match="there is no scorer 'best'") as caught:
        load_scorer("best")
    assert CLARITY in caught.value.hint and "musiq" in caught.value.hint
    with pytest.raises(InputError, match="No such file"):
        load_scorer(str(tmp_path / "none.onnx"))
    (tmp_path / "broken.onnx").write_bytes(b"not a model")
    with pytest.raises(InputError, match="not an ONNX model"):
        load_scorer(str(tmp_path / "broken.onnx"))


def test_a_restorer_is_not_a_scorer() -> None:
    weights = Path(__file__).parents[2] / "cleargs" / "models" / "weights" / "restorer.onnx"
    with pytest.raises(InputError, match="one score"):
        LearnedScorer(weights)


def test_tiles_cover_the_image_and_keep_their_order() -> None:
    image = np.zeros((100, 250, 3), np.float32)
    image[-1, -1] = 1.0  # seen only if the last tile reaches the corner
    assert mean_over_tiles(lambda tiles: (tile.max() for tile in tiles), image, (100, 100)) == 1 / 3
    assert mean_over_tiles(lambda tiles: (tile.max() for tile in tiles), image, (None, None)) == 1.0
    shapes: list[tuple[int, ...]] = []

    def heights(tiles: Sequence[Image]) -> list[float]:
        shapes.extend(tile.shape for tile in tiles)
        return [len(tile) for tile in tiles]

    assert mean_over_tiles(heights, image, (64, 128)) == 64
    assert shapes == [(64, 128, 3)] * 4


def test_quadratic_terms() -> None:
    found = terms(np.array([3.0, 1.0]), mean=np.array([1.0, 1.0]), deviation=np.array([1.0, 2.0]))
    assert found.tolist() == [1.0, 2.0, 0.0, 4.0, 0.0, 0.0]
    capped = terms(np.array([1e9]), mean=np.zeros(1), deviation=np.ones(1))
    assert capped.tolist() == [1.0, 4.0, 16.0]
    assert Quadratic(mean=(1.0,), deviation=(1.0,), weights=(1.0, 2.0, 3.0))(np.array([2.0])) == 6.0


def test_features_show_the_direction_of_change(leaves: Image) -> None:
    """Blur raises the correlation of neighbours, noise lowers it."""
    tile = leaves[:128, :128]
    neighbour = 2  # the larger correlation at a distance of one pixel
    rng = np.random.default_rng(0)
    noisy = np.clip(tile + 0.05 * rng.standard_normal(tile.shape, np.float32), 0, 1)
    blurred = cv2.GaussianBlur(tile, (0, 0), 1.5)
    assert features(noisy)[neighbour] < features(tile)[neighbour] < features(blurred)[neighbour]


def test_the_included_statistics_load() -> None:
    assert StatisticsScorer().name == NATURALNESS
