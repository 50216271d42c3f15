"""The benchmark of qualities: its sums and files, and the reuse of finished runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.commands import invoke
from benchmarks.speed.benchmark_results import describe_machine
from benchmarks.speed.quality_cost import QualityBenchmark, QualityPlan, QualityRow, run
from benchmarks.speed.quality_report import plot_quality, quality_markdown
from cleargs.cli.main import invoke as cleargs
from cleargs.errors import InputError
from cleargs.progress import SilentReporter

ROW = QualityRow(
    "fox",
    "draft",
    seconds={"ingest": 30.0, "g0": 90.0},
    cpu_seconds=200.0,
    peak_memory_gb=1.25,
    steps=800,
    gaussians=20_000,
    images=7,
    means={"psnr": 28.5, "ssim": 0.9, "lpips_alex": None},
)
PLAN = QualityPlan((Path("fox"),), ("draft", "standard"), {"ingest.max_size": 473}, "g0", 2)


def test_row_has_total_and_training_time(tmp_path: Path) -> None:
    rows = [ROW, replace(ROW, quality="standard", cpu_seconds=None, peak_memory_gb=None)]
    benchmark = QualityBenchmark(describe_machine(0.0), PLAN, rows)
    text = quality_markdown(benchmark)
    cells = "| 2.0 | 1.5 | 3.3 | 1.2 | 800 | 20,000 | 28.50 | 0.9000 | unknown |"
    assert f"| fox (7 held out) | draft {cells}" in text
    assert "| standard | 2.0 | 1.5 | unknown | unknown | 800 |" in text
    assert "`ingest.holdout=every:8`, `ingest.max_size=473`" in text
    assert benchmark.as_json()["rows"][0]["total"] == 120.0
    plot_quality(tmp_path / "quality.png", benchmark)
    assert (tmp_path / "quality.png").read_bytes().startswith(b"\x89PNG")


def test_captures_with_one_name_are_refused(tmp_path: Path) -> None:
    plan = replace(PLAN, captures=(tmp_path / "a" / "fox", tmp_path / "b" / "fox"))
    with pytest.raises(InputError, match="same name"):
        run(plan, tmp_path, SilentReporter())


@pytest.mark.slow
def test_command_runs_each_quality_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def call(*words: str) -> str:
        assert invoke(list(words)) == 0
        return capsys.readouterr().out

    assert cleargs(["synth", str(tmp_path / "room"), "--frames", "9", "--size", "64x48"]) == 0
    capsys.readouterr()
    words = ["quality", str(tmp_path / "room"), "-o", str(tmp_path / "out"), "--until", "g0"]
    words += ["--set", "g0.steps=20", "--set", "g0.min_points=300", "--threads", "1", "--json", "-q"]
    values = json.loads(call(*words))
    draft, standard = values["rows"]
    assert (draft["quality"], standard["quality"]) == ("draft", "standard")
    assert draft["steps"] == standard["steps"] == 20
    assert draft["images"] == 2  # every eighth of nine
    # A draft has a separate ingest, with its limits of frames and size.
    assert draft["seconds"].keys() == standard["seconds"].keys() == {"ingest", "rva", "g0"}
    assert draft["means"]["psnr"] > 10
    assert json.loads((tmp_path / "out" / "quality.json").read_text()) == values
    # Finished stages are reused, and later stages of another call do not count.
    call(*words, "--until", "rivr", "--set", "rivr.distil.steps=5", "--quality", "draft")
    again = json.loads(call(*words))
    assert [row["seconds"] for row in again["rows"]] == [row["seconds"] for row in values["rows"]]
