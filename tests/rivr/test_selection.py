"""The choice between candidates."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cleargs.rivr.candidates import Decision, Scores, decide, hide_masked, is_negligible_change

three_scores = st.tuples(*[st.floats(0, 100)] * 3)


def scores(render: float, restored: float, fused: float, **raw: float) -> dict[str, float]:
    return {"render": render, "restored": restored, "fused": fused, **raw}


def choose(primary: Scores, tiebreak: Scores, margin: float) -> Decision:
    """The decision about a frame that may not be kept, with a repair that passes the gates."""
    found = decide(primary, tiebreak, margin)
    assert found.accepted
    return found


BETTER, WORSE, EQUAL = (scores(50, score, 40, observed=59.0) for score in (70, 30, 60))
WITHOUT = scores(50, 70, 40)


@pytest.mark.parametrize(
    ("primary", "facts", "chosen", "accepted", "reason"),
    [
        (BETTER, {}, "restored", True, "primary score"),
        (BETTER, {"refused": "out of place"}, "render", True, "repair refused: out of place"),
        (BETTER, {"explained": "blur 3 px"}, "observed", False, "explained: blur 3 px"),
        (
            BETTER,
            {"explained": "blur 3 px", "refused": "off colour"},
            "observed",
            False,
            "explained: blur 3 px",
        ),
        (BETTER, {"negligible": True}, "restored", True, "primary score"),
        (WORSE, {}, "render", True, "primary score"),
        (WORSE, {"negligible": True}, "observed", False, "needs no repair"),
        (EQUAL, {"negligible": True}, "observed", False, "needs no repair"),
        (WORSE, {"negligible": True, "refused": "off colour"}, "observed", False, "needs no repair"),
        (WITHOUT, {"negligible": True, "explained": "blur 3 px"}, "restored", True, "primary score"),
        (BETTER, {"masked": True}, "restored", False, "every pixel of the frame is masked"),
        (
            BETTER,
            {"masked": True, "refused": "off colour"},
            "render",
            False,
            "every pixel of the frame is masked",
        ),
        (
            BETTER,
            {"masked": True, "explained": "blur"},
            "observed",
            False,
            "every pixel of the frame is masked",
        ),
    ],
)
def test_decision(primary: Scores, facts: dict[str, Any], chosen: str, accepted: bool, reason: str) -> None:
    assert decide(primary, primary, 1.0, **facts) == Decision(chosen, accepted, reason)


def test_a_raw_frame_is_kept_only_if_both_scorers_agree() -> None:
    assert decide(WORSE, BETTER, 1.0, negligible=True).chosen == "render"
    assert decide(BETTER, WORSE, 1.0, negligible=True).chosen == "restored"


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
    assert (
        choose({"render": 40, "restored": 70}, {"render": 9, "restored": 1}, margin=1.0).chosen == "restored"
    )


@given(primary=three_scores, tiebreak=three_scores, margin=st.floats(0, 100))
def test_the_choice_is_never_further_than_the_margin(
    primary: tuple[float, float, float], tiebreak: tuple[float, float, float], margin: float
) -> None:
    p, t = scores(*primary), scores(*tiebreak)
    chosen = choose(p, t, margin).chosen
    assert max(primary) - p[chosen] <= margin
    assert all(t[name] <= t[chosen] for name in p if max(primary) - p[name] <= margin)


def test_scores_must_be_finite() -> None:
    with pytest.raises(ValueError, match="finite"):
        choose(scores(1, math.nan, 2), scores(1, 2, 3), margin=1.0)


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
