"""A small benchmark: all tables, files and pictures, from the command line and from Python."""

from __future__ import annotations

import json

import cv2
import pytest

from benchmarks.commands import invoke
from benchmarks.speed import benchmark_plan as plans
from benchmarks.speed.benchmark import run
from benchmarks.speed.benchmark_plan import BenchmarkCase, Plan, full_plan, quick_plan
from benchmarks.speed.benchmark_results import Benchmark
from benchmarks.speed.markdown import NOT_RUN, markdown, milliseconds
from benchmarks.speed.peak_memory import peak_memory
from benchmarks.speed.timing import Quartiles
from cleargs.progress import SilentReporter

SMALL, LARGE = BenchmarkCase(60, 40, 24), BenchmarkCase(90, 48, 32)


def toy_plan() -> Plan:
    return Plan(
        cases=(SMALL, LARGE),
        threads=(1,),
        rounds=1,
        repetitions=1,
        torch_rounds=1,
        torch_largest=SMALL,
        roofline=SMALL,
        more_splats=(SMALL, LARGE),
        larger_splats=(SMALL, BenchmarkCase(60, 40, 24, 5.0)),
        memory=False,
        peak_repeats=1,
        seed=4,
    )


@pytest.fixture(scope="module")
def benchmark() -> Benchmark:
    return run(toy_plan(), SilentReporter())


def test_every_row_has_times_and_errors(benchmark):
    for row, case in zip(benchmark.rows, (SMALL, LARGE), strict=True):
        assert row.case == case
        assert set(row.accuracy.gradients) == {"means", "log_scales", "rotations", "logit_opacities", "sh"}
        assert 0 < row.accuracy.image.max < 1e-5
        assert 0 < row.accuracy.worst_gradient < 1e-4
        assert row.accuracy.pixels + row.accuracy.left_out == min(1000, case.width * case.height)
        assert row.pairs > 0 and row.times[1]["iteration"].median > 0
    small, large = benchmark.rows
    assert large.rasterisers is None
    other = small.rasterisers.torch
    assert 0 < other.accuracy.worst_gradient < 1e-4
    assert other.accuracy.image.max < 1e-5
    assert other.ratio[1].median == pytest.approx(other.times[1].median / small.rasterisers.ours[1].median)


def test_tables_name_cases_that_were_not_run(benchmark):
    text = markdown(benchmark)
    lines = [line for line in text.splitlines() if line.startswith(f"| {LARGE.title} | 1 | {NOT_RUN}")]
    assert len(lines) == 1
    assert "seed 4" in text
    assert f"{benchmark.rows[0].accuracy.worst_gradient:.1e}" in text
    assert milliseconds(benchmark.rows[0].rasterisers.torch.ratio[1]) in text
    assert text.count("rasterise.backward") == 1
    assert "unknown" in text  # memory was not measured
    for table in text.split("\n\n"):
        if table.startswith("|"):
            assert len({line.count("|") for line in table.splitlines()}) == 1


def test_json_is_complete(benchmark):
    values = json.loads(json.dumps(benchmark.as_json()))
    assert values["rows"][0]["case"] == {"gaussians": 60, "width": 40, "height": 24, "sigma": 1.8}
    assert values["rows"][1]["rasterisers"] is None
    assert values["rows"][0]["times"]["1"]["forward"].keys() == {"low", "median", "high"}
    assert [point["case"]["gaussians"] for point in values["scaling"]["more splats"]] == [60, 90]
    assert len(values["roofline"]["kernels"]["1"]) == 12


@pytest.mark.slow
def test_command_writes_tables_and_pictures(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plans, "quick_plan", lambda threads: toy_plan())
    options = ["--quick", "--threads", "1", "--seed", "9", "-q", "--json", "-o", str(tmp_path)]
    assert invoke(["splat", *options]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert {row["accuracy"]["seed"] for row in printed["rows"]} == {9}
    assert json.loads((tmp_path / "splat.json").read_text()) == printed
    assert "torch / ours" in (tmp_path / "splat.md").read_text()
    for name in ("speed-error.png", "scaling.png"):
        picture = cv2.imread(str(tmp_path / name))
        assert picture.shape[0] > 300 and picture.std() > 5


@pytest.mark.slow
def test_command_prints_the_tables(monkeypatch, capsys):
    monkeypatch.setattr(plans, "quick_plan", lambda threads: toy_plan())
    assert invoke(["splat", "--quick", "--threads", "1", "-q"]) == 0
    assert capsys.readouterr().out.startswith("# Speed and error of the rasteriser")


@pytest.mark.slow
def test_peak_memory_is_that_of_the_scene():
    """Each of 20,000 splats has parameters, two moments and gradients, 59 floats each; buffers need more."""
    found = peak_memory(20_000, 64, 48, 1.8)
    if found is None:
        pytest.skip("this system does not report peak memory")
    least = 20_000 * 4 * 59 * 4
    assert least < found < 5 * least


def test_plans_name_cases_that_are_measured():
    for plan in (full_plan((1, 2)), quick_plan((1,))):
        compared = [plan.compares_torch(case) for case in plan.cases]
        assert any(compared) and not all(compared)
    assert not full_plan((1,)).compares_torch(BenchmarkCase(200_000, 320, 180))
    assert not full_plan((1,)).compares_torch(BenchmarkCase(10_000, 1280, 720))
    assert milliseconds(Quartiles(1.0, 2.0, 30.0)) == "2.00 [1.00 30.00]"


def test_train_reports_each_part(capsys):
    size = ["--gaussians", "50", "--width", "33", "--height", "17", "--threads", "1", "--repeats", "1"]
    assert invoke(["train", *size, "--json"]) == 0
    row = json.loads(capsys.readouterr().out)
    parts = [row[name] for name in ("forward", "loss", "backward", "adam")]
    assert row["gaussians"] == 50 and min(parts) > 0 and row["iteration"] >= max(parts)
