"""`compare` on a tiny capture: shared stages run once, and a second call reuses everything."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.commands import invoke
from benchmarks.comparison import findings
from benchmarks.comparison.cells import Cell
from benchmarks.comparison.choices import measure_choices
from benchmarks.comparison.equal_work import EqualWork, decide_work
from benchmarks.comparison.scenes import (
    FinishedScene,
    SceneRecipe,
    cached_evaluation,
    scene_of_run,
    view_sets,
)
from cleargs.capture.tables import load_frames
from cleargs.cli.common import DONE_IN_PART
from cleargs.errors import InputError
from cleargs.evaluate import metrics
from cleargs.evaluate.config import EvalOptions
from cleargs.pipeline.config import load_config
from cleargs.pipeline.run_file import RUN_FILE
from cleargs.pipeline.session import opened_store
from cleargs.pipeline.stages import installed
from cleargs.pipeline.store import STORE_FOLDER
from cleargs.progress import SilentReporter
from cleargs.splat.config import budget_from_pixels
from cleargs.splat.initialise import sh_degree_from_views
from cleargs.synth.synthetic_capture import make_capture

pytestmark = pytest.mark.slow

SETTINGS = {
    "ingest.max_features": "512",
    "rva.tau_R": "0.95",  # so that binary weights, graded weights and 1 differ
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


TOTAL = 12 + 6 + 6
"""Steps of the whole method with these settings. The recipe `smoke` has one round."""


def compare(capture: Path, *more: str) -> int:
    settings = [part for name, value in SETTINGS.items() for part in ("--set", f"{name}={value}")]
    return invoke(
        ["compare", str(capture), "--workflow", "smoke", "--quiet", "--lpips", "alex", *settings, *more]
    )


def test_every_variant_is_evaluated_on_both_view_sets(out: Path) -> None:
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
        # After two dozen steps the scene shows the room; its mean colour alone reaches 12 dB.
        assert 12.0 < cell["means"]["psnr"] < 40.0
        assert (out / cell["evaluation"] / "eval.json").is_file()
        assert (cell["steps"], cell["sh_degree"]) == (TOTAL, 1)
        assert cell["cpu_seconds"] > 0.0 and 0.05 < cell["peak_memory_gb"] < 10.0
    # All grow to the same budget.
    assert {cell["gaussians"] for cell in cells.values()} == {500}
    assert cells["rva", "observed"]["evaluation"] != cells["all-view", "observed"]["evaluation"]
    for name in ("comparison.md", "comparison.png", "sheet.png"):
        assert (out / name).stat().st_size > 0


def test_page_shows_every_variant_at_every_pose(out: Path) -> None:
    text = (out / "report/index.html").read_text()
    poses = json.loads(re.search(r'id="data">(.*?)</script>', text, re.S)[1])["frames"]
    # Only the poses of the path have a filmed frame.
    assert [len(pose["layers"]) for pose in poses] == [6, 6, 6, 5, 5, 5]
    assert "All were trained for the same number of steps" in text
    for page in (text, (out / "comparison.md").read_text()):
        assert "Training poses: the scenes were trained on the frames filmed here" in page


def test_variants_share_equal_stages(out: Path) -> None:
    stored = {stage: list((out / ".store" / stage).iterdir()) for stage in ("ingest", "rva", "g0")}
    assert len(stored["ingest"]) == 2  # with and without a search for a rolling shutter
    assert len(stored["rva"]) == 3  # all views, binary weights, graded weights
    assert len(stored["g0"]) == 4  # `full` has fewer G0 steps than `rva`
    cells = json.loads((out / "comparison.json").read_text())["cells"]
    shared = {cell["variant"]: cell["shared_seconds"] for cell in cells}
    assert shared["all-view"] == 0.0
    assert shared["rva"] > shared["full"] > 0.0  # `full` has its own ingest, and shares the weights only


def test_results_contain_roles_and_choices(out: Path) -> None:
    found = json.loads((out / "comparison.json").read_text())
    roles = {scene["variant"]: scene["frames"] for scene in found["roles"]}
    assert all(sum(frames.values()) == 6 for frames in roles.values())
    assert roles["all-view"]["strong"] == 6
    assert roles["drop-blurry"]["suppressed"] > 0
    assert roles["rva"] == roles["full"]
    (scene,) = found["choices"]
    assert scene["variant"] == "full" and scene["rows"]
    for row in scene["rows"]:
        assert {"render", "restored", "observed"} <= row["psnr"].keys() and row["chosen"] in row["psnr"]
    text = (out / "comparison.md").read_text()
    assert "| all-view G0 | 24 |" in text and "best by PSNR" in text


def test_frame_without_truth_is_left_out(capture: Path, out: Path, tmp_path: Path) -> None:
    shutil.copytree(capture, tmp_path / "room")
    run = out / "room-0" / "full"
    judged = {row.frame_id for row in measure_choices(run, tmp_path / "room", None)}
    lost = min(judged)
    stem = Path({frame.frame_id: frame.name for frame in load_frames(run / "ingest")}[lost]).stem
    (tmp_path / "room" / "truth" / "observed" / "images" / f"{stem}.png").unlink()
    assert {row.frame_id for row in measure_choices(run, tmp_path / "room", None)} == judged - {lost}


def test_budget_and_degree_depend_on_every_frame(capture: Path, out: Path) -> None:
    config = load_config(installed(), "default", ("g0.budget=7",), 0)
    frames = 6 * 160 * 90
    open_ = decide_work(load_config(installed(), "default", (), 0), out / "room-0" / "rva" / "ingest", None)
    assert open_ == EqualWork(2850, 6, budget_from_pixels(frames, 10**6), sh_degree_from_views(6))
    assert decide_work(config, out / "room-0" / "rva" / "ingest", 50) == EqualWork(50, 6, 7, 0)


def test_steps_option_sets_the_total(capture: Path, out: Path) -> None:
    assert compare(capture, "-o", str(out), "--variants", "all-view,full", "--steps", "20") == 0
    cells = json.loads((out / "comparison.json").read_text())["cells"]
    assert {cell["steps"] for cell in cells} == {20}
    assert compare(capture, "-o", str(out), "--variants", "all-view,drop-blurry,rva,full") == 0


def test_repeated_command_reuses_everything(capture: Path, out: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (out / ".store").rglob("manifest.json")}
    judged = {path: path.stat().st_mtime_ns for path in (out / "evaluations").rglob("eval.json")}
    table = (out / "comparison.json").read_bytes()
    assert compare(capture, "-o", str(out), "--variants", "all-view,drop-blurry,rva,full") == 0
    assert before == {path: path.stat().st_mtime_ns for path in (out / ".store").rglob("manifest.json")}
    assert judged == {path: path.stat().st_mtime_ns for path in (out / "evaluations").rglob("eval.json")}
    assert (out / "comparison.json").read_bytes() == table


def test_finished_runs_are_compared(out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [str(out / "room-0" / name) for name in ("all-view", "full")]
    more = ["-o", str(tmp_path / "runs"), "--lpips", "alex", "--quiet", "--json"]
    assert invoke(["compare", *runs, *more]) == 0
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


def test_capture_without_reference_is_refused(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "images").symlink_to(capture / "images")
    (bare / "transforms.json").symlink_to(capture / "transforms.json")
    assert compare(bare, "-o", str(tmp_path / "out"), "--variants", "all-view") == 2
    assert "sharpest:8" in capsys.readouterr().err
    assert not (tmp_path / "out" / "bare-0").exists(), "no run was started"


def test_two_captures_with_one_name_are_refused(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "other" / "room").mkdir(parents=True)
    code = invoke(["compare", str(capture), str(tmp_path / "other" / "room"), "-o", str(tmp_path / "out")])
    assert code == 2
    assert "two captures have the name room" in capsys.readouterr().err


@pytest.mark.parametrize("option", [["--steps", "100"], ["--set", "g0.steps=9"], ["--quality", "draft"]])
def test_training_options_are_refused_for_runs(
    option: list[str], out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [str(out / "room-0" / name) for name in ("all-view", "full")]
    assert invoke(["compare", *runs, "-o", str(tmp_path / "out"), "--quiet", *option]) == 2
    assert f"{option[0]} cannot change finished runs" in capsys.readouterr().err


def test_two_runs_with_one_name_are_refused(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They would share one row of the tables."""
    other = tmp_path / "other"
    shutil.copytree(out / "room-0", other / "room-0", symlinks=True)
    runs = [str(out / "room-0" / "rva"), str(other / "room-0" / "rva")]
    assert invoke(["compare", *runs, "-o", str(tmp_path / "out"), "--quiet"]) == 2
    assert "two runs have the name rva" in capsys.readouterr().err


def test_runs_of_captures_with_one_name_are_refused(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their scenes would be paired although they show different places."""
    other = tmp_path / "house2"
    shutil.copytree(out / "room-0", other, symlinks=True)
    (other / "rva").rename(other / "rva2")
    noted = other / "rva2" / RUN_FILE
    twin = tmp_path / "room"
    twin.mkdir()
    text = noted.read_text()
    place = re.search(r'"([^"]*/room)"', text)
    assert place is not None
    noted.write_text(text.replace(place[1], str(twin)))
    runs = [str(out / "room-0" / "all-view"), str(other / "rva2")]
    assert invoke(["compare", *runs, "-o", str(tmp_path / "out"), "--quiet"]) == 2
    assert "two captures of these runs have the name room" in capsys.readouterr().err


def test_metric_is_measured_once_its_weights_exist(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cached evaluation without a metric is not reused after its weights were installed."""
    run = out / "room-0" / "all-view"
    dag, options = installed(), EvalOptions(lpips=(), scorers=("clarity-net",))

    def kept_weights() -> dict[str, str]:
        recipe = SceneRecipe(dag, "smoke", (), "cpu", 1, options)
        with opened_store(out / STORE_FOLDER) as store:
            made = scene_of_run(run, dag, None)
            return cached_evaluation(tmp_path, made, view_sets(made)[0], recipe, store, SilentReporter())[
                0
            ].weights

    whole = metrics.load_metrics(options)
    bare = replace(whole, scorers={}, weights={}, unavailable={"clarity-net": "not installed"})
    monkeypatch.setattr(metrics, "load_metrics", lambda options: bare)
    assert kept_weights() == {}
    monkeypatch.undo()
    assert kept_weights() == whole.weights


def test_failed_evaluation_does_not_stop_the_others(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluate_views = findings.evaluate_views

    def fail_once(folder: Path, made: FinishedScene, *rest: Any) -> list[Cell]:
        if made.variant.name == "all-view":
            raise InputError("two images are called 0001", hint="give them different names")
        return evaluate_views(folder, made, *rest)

    monkeypatch.setattr(findings, "evaluate_views", fail_once)
    runs = [str(out / "room-0" / name) for name in ("all-view", "rva", "full")]
    code = invoke(["compare", *runs, "-o", str(tmp_path / "out"), "--lpips", "none", "--quiet", "--json"])
    document = json.loads(capsys.readouterr().out)
    assert {cell["variant"] for cell in document["cells"]} == {"rva", "full"}
    assert "two images are called 0001" in document["failures"][0]
    assert code == DONE_IN_PART
