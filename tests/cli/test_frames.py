"""``cleargs show``: role, reason and repair of every frame."""

from __future__ import annotations

from typing import Any

import pytest

from cleargs.cli.frame_rows import frame_rows, reason, score_text, short_name
from cleargs.cli.show import labelled
from cleargs.report.frames import worst_cue
from cleargs.rva.tables import B_CUES, R_CUES
from cleargs.stages.rva import RvaConfig

SETTINGS = RvaConfig().model_dump(mode="json")


def row(role: str, R: float | None, B: float | None, G: float | None = 0.1, **more: Any) -> dict[str, Any]:
    cues = {**{f"r_{name}": 1.0 for name in R_CUES}, **{f"b_{name}": 0.0 for name in B_CUES}}
    plain = {"frame_id": 3, "name": "images/a.jpg", "weight": 0.5, "reactivated_for": None}
    return {**plain, **cues, "role": role, "R": R, "B": B, "G": G, **more}


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (row("strong", 0.9, 0.1), "reliable"),
        (row("geometric", 0.6, 0.1, 0.7), "R < 0.7, adds views"),
        (row("geometric", 0.9, 0.7, 0.7), "B > 0.6, adds views"),
        (row("auxiliary", 0.6, 0.1, 0.3), "R < 0.7, usable"),
        (row("suppressed", 0.3, 0.1), "R < 0.35"),
        (row("suppressed", 0.9, 0.9), "B > 0.75"),
        (row("suppressed", 0.6, 0.1, 0.1), "R < 0.7, no new view"),
        (row("reactivated", 0.6, 0.1, reactivated_for="active_share"), "R < 0.7, no new view"),
        (row("reactivated", 0.3, 0.1, reactivated_for="coverage"), "R < 0.35, fills a gap"),
        (row("suppressed", 0.9, 0.1, None), "no pose found"),
        (row("suppressed", None, None, None), "not scored"),
    ],
)
def test_the_reason_names_the_threshold_that_decided(frame: dict[str, Any], words: str) -> None:
    assert reason(frame, SETTINGS) == words
    assert len(words) <= 22, "the table must fit in 100 columns"


def test_ablations_give_their_own_reasons() -> None:
    assert reason(row("strong", 0.1, 0.9), {**SETTINGS, "enabled": False}) == "all frames count"
    binary = {**SETTINGS, "weighting": "binary"}
    assert reason(row("auxiliary", 0.1, 0.9), binary) == "among the best"
    assert reason(row("suppressed", 0.1, 0.9), binary) == "not among the best"


def test_the_worst_cue_of_both_kinds() -> None:
    assert worst_cue(row("strong", 1, 0, b_motion_blur=0.6, r_sharpness=0.5)) == "motion blur 0.60"
    assert worst_cue(row("strong", 1, 0, b_motion_blur=0.6, r_sharpness=0.3)) == "low sharpness 0.70"
    assert worst_cue(row("strong", 1, 0, b_motion_blur=0.1)) == "", "no fault"


def test_the_repair_of_a_frame_is_that_of_its_last_round() -> None:
    def chosen(number: int, layer: str, why: str = "primary score", accepted: bool = True) -> dict[str, Any]:
        return {"frame_id": 3, "round": number, "chosen": layer, "reason": why, "accepted": accepted}

    frames = [row("strong", 0.9, 0.1)]

    def repair(*rows: dict[str, Any]) -> Any:
        return frame_rows(frames, SETTINGS, rows)[0]["repair"]

    assert repair() == "none"
    assert repair(chosen(2, "restored"), chosen(1, "render")) == "restored", "the last round counts"
    assert repair(chosen(1, "render", "repair refused: 12% of its blocks out of place")) == "refused"
    assert repair(chosen(1, "render", "every pixel of the frame is masked", accepted=False)) == "refused"
    assert repair(chosen(1, "observed", "explained: motion 3 px", accepted=False)) == "as filmed"
    assert repair(chosen(1, "observed", "every pixel of the frame is masked", accepted=False)) == "as filmed"
    assert "repair" not in frame_rows(frames, SETTINGS, None)[0]
    names = ["frame", "name", "role", "weight", "R", "B", "worst cue", "reason", "repair"]
    assert list(frame_rows(frames, SETTINGS, [])[0]) == names


def test_names_keep_their_end() -> None:
    assert short_name("images/000012.jpg") == "000012.jpg"
    assert short_name("a long walk in the garden_000012") == "…garden_000012"


def test_figures_have_labels() -> None:
    summary = {
        "control": {"frames": [1, 2], "psnr_before": 22.5, "harm": None},
        "holdout_hash": "ab" * 32,
        "latest_rounds": {"2": 11},
        "rounds": [{"round": 1, "chosen": {"render": 3, "restored": 9, "fused": 0, "observed": 2}}],
        "weights": {"0.0": 0, "0.1": 5, "0.9": 7},
        "some_new_figure": 3,
    }
    assert list(labelled(summary)) == [
        ("control frames: frames", "1, 2"),
        ("control frames: PSNR in the first scene, dB", "22.5"),
        ("control frames: harm", "none"),
        ("repairs by round", "11 in round 2"),
        ("round 1: chosen", "3 render, 9 restored, 2 as filmed"),
        ("weights", "5 from 0.1, 7 from 0.9"),
        ("some new figure", "3"),
    ]


def test_scores_have_the_digits_that_decide() -> None:
    """Once, R 0.695 was printed as 0.70, next to the reason R < 0.7."""
    assert [score_text("R", value, SETTINGS) for value in (0.695374, 0.69999, 0.7, 0.62)] == [
        "0.695",
        "0.69999",
        "0.700000",
        "0.62",
    ]
    assert score_text("B", 0.6004, SETTINGS) == "0.6004" and score_text("G", 0.25, {}) == "0.25"
