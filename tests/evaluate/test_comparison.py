"""`cleargs compare` on a tiny capture: shared stages are made once, and a second call makes nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cleargs.cli.main import invoke
from cleargs.evaluate.variants import VARIANTS, Variant
from cleargs.pipeline.config import load_config
from cleargs.pipeline.dag import installed
from cleargs.progress import SilentReporter
from cleargs.synth.capture import make_capture

SETTINGS = {
    "ingest.max_features": "512",
    "rva.tau_R": "0.95",  # so that binary and graded weights differ from one another and from 1
    "g0.steps": "12",
    "g0.min_points": "400",
    "g0.budget": "500",
    "rivr.distil.steps": "6",
    "consolidate.distil.steps": "6",
}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "room"
    make_capture(folder, "mixed", frames=6, width=160, height=90, seed=3, reporter=SilentReporter())
    return folder


@pytest.fixture(scope="module")
def out(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("comparison") / "table"
    assert compare(capture, "-o", str(folder), "--variants", "all-view,drop-blurry,rva,full") == 0
    return folder


def compare(capture: Path, *more: str) -> int:
    settings = [part for name, value in SETTINGS.items() for part in ("--set", f"{name}={value}")]
    return invoke(["compare", str(capture), "--workflow", "smoke", "--quiet", *settings, *more])


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_the_settings_of_every_variant_exist(variant: Variant) -> None:
    plain = load_config(installed(), "default")
    assert (load_config(installed(), "default", variant.overrides) == plain) == (not variant.overrides)


def test_every_variant_is_judged_on_both_sets_of_views(out: Path) -> None:
    found = json.loads((out / "comparison.json").read_text())
    assert found["failures"] == []
    cells = {(cell["variant"], cell["views"]): cell for cell in found["cells"]}
    assert cells.keys() == {
        (name, views)
        for name in ("all-view", "drop-blurry", "rva", "full")
        for views in ("observed", "novel")
    }
    for cell in cells.values():
        assert cell["column"] == "mixed"
        # Twelve steps make no good scene, but one that shows the room: its mean colour alone gives 12 dB.
        assert 12.0 < cell["means"]["psnr"] < 40.0
        assert (out / cell["evaluation"] / "eval.json").is_file()
    assert cells["rva", "observed"]["evaluation"] != cells["all-view", "observed"]["evaluation"]
    for name in ("comparison.md", "comparison.png", "sheet.png"):
        assert (out / name).stat().st_size > 0


def test_variants_share_what_they_agree_on(out: Path) -> None:
    stored = {stage: list((out / ".store" / stage).iterdir()) for stage in ("ingest", "rva", "g0")}
    assert len(stored["ingest"]) == 1
    assert len(stored["rva"]) == 3  # all views, binary weights, graded weights
    assert len(stored["g0"]) == 3  # that of graded weights serves `rva` and `full`
    cells = json.loads((out / "comparison.json").read_text())["cells"]
    shared = {cell["variant"]: cell["shared_seconds"] for cell in cells}
    assert shared["all-view"] == 0.0
    assert shared["full"] > shared["rva"] > 0.0


def test_the_same_command_again_makes_nothing(capture: Path, out: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (out / ".store").rglob("manifest.json")}
    judged = {path: path.stat().st_mtime_ns for path in (out / "evaluations").rglob("eval.json")}
    table = (out / "comparison.json").read_bytes()
    assert compare(capture, "-o", str(out), "--variants", "all-view,drop-blurry,rva,full") == 0
    assert before == {path: path.stat().st_mtime_ns for path in (out / ".store").rglob("manifest.json")}
    assert judged == {path: path.stat().st_mtime_ns for path in (out / "evaluations").rglob("eval.json")}
    assert (out / "comparison.json").read_bytes() == table


def test_finished_runs_stand_side_by_side(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [str(out / "room-0" / name) for name in ("all-view", "full")]
    assert invoke(["compare", *runs, "-o", str(tmp_path / "runs"), "--quiet", "--json"]) == 0
    cells = json.loads(capsys.readouterr().out)["cells"]
    old = json.loads((out / "comparison.json").read_text())["cells"]
    means = {(cell["variant"], cell["views"]): cell["means"] for cell in old}
    for cell in cells:
        assert cell["means"] == means[cell["variant"], cell["views"]]


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        (["--variants", "all-veiw"], "did you mean all-view"),
        (["--seeds", "one"], "whole numbers"),
        (["--lpips", "squeeze"], "choose among"),
    ],
)
def test_bad_arguments(
    arguments: list[str], cause: str, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare(capture, "-o", str(tmp_path / "out"), *arguments) == 2
    assert cause in capsys.readouterr().err


def test_a_capture_without_truth_or_held_out_frames_is_refused(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "images").symlink_to(capture / "images")
    (bare / "transforms.json").symlink_to(capture / "transforms.json")
    assert compare(bare, "-o", str(tmp_path / "out"), "--variants", "all-view") == 2
    assert "sharpest:8" in capsys.readouterr().err


def test_two_captures_of_one_name_are_refused(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other" / "room").mkdir(parents=True)
    code = invoke(["compare", str(capture), str(tmp_path / "other" / "room"), "-o", str(tmp_path / "out")])
    assert code == 2
    assert "two captures are called room" in capsys.readouterr().err
