"""The choice between candidates."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cleargs.rivr.candidates import (
    CANDIDATES,
    CandidateName,
    choose,
    hide_masked,
    is_negligible_change,
    unbeaten,
)

three_scores = st.tuples(*[st.floats(0, 100)] * 3)


def scores(render: float, restored: float, fused: float) -> dict[CandidateName, float]:
    return {"render": render, "restored": restored, "fused": fused}


def test_primary_decides_beyond_the_margin() -> None:
    choice = choose(scores(50, 60, 58.9), scores(90, 10, 95), margin=1.0)
    assert (choice.chosen, choice.reason) == ("restored", "primary score")


def test_tiebreak_decides_within_the_margin_and_only_there() -> None:
    """The render's tie-break score is the best of all, but its primary score is too far off."""
    choice = choose(scores(50, 60, 59.5), scores(99, 10, 20), margin=1.0)
    assert choice.chosen == "fused"
    assert choice.reason == "tie-break among restored, fused"


def test_the_margin_itself_is_within() -> None:
    assert choose(scores(0, 60, 59), scores(0, 1, 2), margin=1.0).chosen == "fused"
    assert choose(scores(0, 60, np.nextafter(59.0, 0.0)), scores(0, 1, 2), margin=1.0).chosen == "restored"


def test_ties_in_the_tiebreak_go_to_the_primary_score_then_to_the_order() -> None:
    assert choose(scores(60, 60.5, 60), scores(5, 5, 5), margin=1.0).chosen == "restored"
    assert choose(scores(60, 60, 60), scores(5, 5, 5), margin=1.0).chosen == "render"


def test_without_margin_only_exact_ties_are_broken() -> None:
    assert choose(scores(60, 60, 0), scores(1, 2, 9), margin=0.0).chosen == "restored"
    assert choose(scores(60, 59.999, 0), scores(1, 2, 9), margin=0.0).chosen == "render"


def test_two_candidates_suffice() -> None:
    primary: dict[CandidateName, float] = {"render": 40, "restored": 70}
    assert choose(primary, {"render": 9, "restored": 1}, margin=1.0).chosen == "restored"


@given(primary=three_scores, tiebreak=three_scores, margin=st.floats(0, 100))
def test_the_choice_is_never_further_than_the_margin(
    primary: tuple[float, float, float], tiebreak: tuple[float, float, float], margin: float
) -> None:
    p, t = scores(*primary), scores(*tiebreak)
    chosen = choose(p, t, margin).chosen
    assert max(primary) - p[chosen] <= margin
    assert all(t[name] <= t[chosen] for name in CANDIDATES if max(primary) - p[name] <= margin)


def test_scores_must_be_finite() -> None:
    with pytest.raises(ValueError, match="finite"):
        choose(scores(1, math.nan, 2), scores(1, 2, 3), margin=1.0)


def test_a_raw_frame_is_unbeaten_up_to_the_margin() -> None:
    assert unbeaten(59.0, scores(50, 60, 40), margin=1.0)
    assert not unbeaten(58.9, scores(50, 60, 40), margin=1.0)


def test_a_repair_that_changes_little_beside_what_is_unexplained() -> None:
    """Powers of 0.1^2 and 1: a tenth of the change that would count; 0.5^2 is a quarter."""
    observed = np.zeros((8, 8, 3), np.float32)
    render = observed + np.float32(1.0)
    assert is_negligible_change(observed, observed + np.float32(0.1), render)
    assert not is_negligible_change(observed, observed + np.float32(0.5), render)
    assert not is_negligible_change(observed, observed, observed)  # nothing to go by


def test_masked_pixels_are_the_observation_in_every_candidate() -> None:
    rng = np.random.default_rng(0)
    image, other, observed = rng.random((3, 5, 6, 3), dtype=np.float32)
    mask = rng.random((5, 6)) > 0.5
    altered = np.where(mask[..., None], image, other)
    shown = hide_masked(image, observed, mask)
    np.testing.assert_array_equal(shown, hide_masked(altered, observed, mask))
    np.testing.assert_array_equal(shown[mask], image[mask])
    np.testing.assert_array_equal(shown[~mask], observed[~mask])
    assert hide_masked(image, observed, None) is image
