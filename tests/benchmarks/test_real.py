"""`python -m benchmarks real`: its list, its table, and a tiny benchmark that is resumed."""

from __future__ import annotations

import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from benchmarks.commands import invoke
from benchmarks.comparison import real
from benchmarks.comparison.cells import Cell
from benchmarks.comparison.findings import Comparison
from benchmarks.comparison.real import (
    RealResults,
    RealScene,
    find_scenes,
    read_real_list,
    read_results,
    real_table,
    run_scenes,
    showcase,
    summary_table,
    with_tables,
)
from benchmarks.comparison.scenes import SceneRecipe, compared_means
from cleargs.errors import InputError
from cleargs.evaluate.config import EvalOptions
from cleargs.evaluate.eval_report import Evaluation
from cleargs.media.image import read_rgb
from cleargs.pipeline.config import load_config
from cleargs.pipeline.session import opened_store
from cleargs.pipeline.stages import installed
from cleargs.progress import SilentReporter
from cleargs.scene.folder import FORMATION
from cleargs.synth.synthetic_capture import make_capture

SETTINGS = ("g0.min_points=400", "g0.budget=500", "ingest.max_features=512", "ingest.holdout=every:3")


def cell(variant: str, seed: int, psnr: float) -> Cell:
    return Cell(
        column="blurball",
        sample=f"blurball-{seed}",
        variant=variant,
        views="held-out",
        means={
            "psnr": psnr,
            "ssim": 0.8,
            "lpips_alex": 0.2,
            "psnr_refined": psnr + 0.5,
            "lpips_alex_refined": 0.1,
        },
        images=4,
        seconds=60,
        shared_seconds=0,
        gaussians=1000,
        steps=3200,
        sh_degree=1,
        cpu_seconds=120,
        peak_memory_gb=1,
        evaluation=f"evaluations/{variant}-{seed}",
    )


def test_a_scene_with_image_formation_is_compared_as_its_frames_were_filmed(tmp_path: Path) -> None:
    found = Evaluation.model_construct(means={"psnr": 29.0, "covered": 0.1}, formed={"psnr": 32.0})
    assert compared_means(tmp_path / "scene.ply", found) == {"psnr": 29.0, "covered": 0.1}
    pq.write_table(pa.table({"frame_id": [0]}), tmp_path / FORMATION)
    assert compared_means(tmp_path / "scene.ply", found) == {"psnr": 32.0, "covered": 0.1}


def test_the_list_has_valid_settings_and_names_its_sources() -> None:
    listed = read_real_list()
    assert [scene.name for scene in listed.scenes] == [
        "blurball",
        "kitchen",
        "office",
        "fox",
        "terrace",
        "bonsai",
    ]
    for scene in listed.scenes:
        config = load_config(installed(), "default", scene.settings, 0)
        assert config.sections["ingest"].holdout != "none"  # type: ignore[attr-defined]
    assert all(one.source and one.protocol for one in listed.published)
    with pytest.raises(InputError, match="kitchn"):
        find_scenes(listed, ["kitchn"])


def results() -> RealResults:
    """Two trainings of blurball, and a scene that could not be made."""
    cells = [
        cell(name, seed, 29.0 + 2 * seed - (name == "all-view"))
        for name in ("all-view", "full")
        for seed in (0, 1)
    ]
    return RealResults().with_results(
        Comparison(cells=cells, failures=["fox: it is missing"]), "0.2.0, abc, source 0123"
    )


def test_the_table_has_means_over_seeds_and_published_figures() -> None:
    table = real_table(read_real_list(), results())
    means = "30.00 ± 1.41 | 0.800 ± 0.000 | 0.200 ± 0.000 | 30.50 ± 1.41 | 0.100 ± 0.000"
    assert f"| blurball | ClearGS | {means} | 2.0 |" in table
    assert "| blurball | *Deblur-NeRF, 200,000 iterations* | 27.33 | 0.770 | 0.223 | - | - | - |" in table
    second_hand = [line for line in table.splitlines() if "CoMoGaussian" in line and line.startswith("|")]
    assert len(second_hand) == 1 and "* * |" in second_hand[0]
    assert "Not made: fox: it is missing." in table and "blurball: Deblur-NeRF's real scene" in table


def test_the_short_table_has_a_row_per_scene() -> None:
    table = summary_table(read_real_list(), results())
    (row,) = [line for line in table.splitlines() if line.startswith("| blurball")]
    means = "29.00 ± 1.41 / 0.200 ± 0.000 | 30.00 ± 1.41 / 0.200 ± 0.000"
    assert row.endswith(f"| {means} | **+1.00 ± 0.00** / +0.000 ± 0.000 | 2.0 and 2.0 |")
    assert "| *Deblur-NeRF, 200,000 iterations, on blurball* |  | *27.33 / 0.223* |  |  |" in table
    assert "blurball: mean of 2 trainings, version 0.2.0, abc." in table and "CoMoGaussian" not in table
    assert "Still to be measured: kitchen, office, fox, terrace, bonsai." in table


def test_scenes_of_an_earlier_call_stay_with_their_version(tmp_path: Path) -> None:
    fox = cell("full", 0, 25.0).model_copy(update={"column": "fox"})
    both = results().with_results(Comparison(cells=[fox]), "0.3.0, def")
    assert both.scenes.keys() == {"blurball", "fox"} and both.failures == ()
    (tmp_path / "real.json").write_text(both.model_dump_json())
    assert read_results(tmp_path / "real.json") == both
    table = real_table(read_real_list(), both)
    assert "version 0.2.0, abc" in table and "version 0.3.0, def" in table
    assert "| fox: phone video of an exhibit, mostly sharp | - | 25.00" in summary_table(
        read_real_list(), both
    )
    assert read_results(tmp_path / "absent.json") == RealResults()


def test_variants_of_an_earlier_call_stay_with_their_version() -> None:
    listed = read_real_list()
    added = results().with_results(Comparison(cells=[cell("paper-open", 0, 24.0)]), "0.3.0, def, source 4567")
    table = real_table(listed, added)
    labels = [line.split(" | ")[1] for line in table.splitlines() if line.startswith("| blurball")]
    assert labels[:3] == ["all frames alike", "ClearGS", "paper's method, open models"]
    assert "all frames alike, ClearGS: mean of 2 trainings, version 0.2.0, abc, source 0123; " in table
    assert "paper's method, open models: one training, version 0.3.0, def, source 4567." in table
    assert "blurball: mean of 2 trainings, version 0.2.0, abc." in summary_table(listed, added)
    again = added.with_results(Comparison(cells=[cell("full", 0, 31.0)]), "0.3.0, def")
    assert list(again.scenes["blurball"]) == ["all-view", "full", "paper-open"]
    assert [one.means["psnr"] for one in again.scenes["blurball"]["full"].cells] == [31.0]
    assert "| +3.00 / +0.000 | 2.0 and 2.0 |" in summary_table(listed, again), "pairs of the same seed"


def test_a_scene_without_the_compared_variants_is_still_to_be_measured() -> None:
    only = RealResults().with_results(Comparison(cells=[cell("paper-open", 0, 24.0)]), "0.3.0, def")
    table = summary_table(read_real_list(), only)
    assert "| blurball" not in table and "Still to be measured: blurball, kitchen" in table
    assert "| blurball | paper's method, open models | 24.00" in real_table(read_real_list(), only)


def test_results_of_another_form_are_not_taken_for_none(tmp_path: Path) -> None:
    (tmp_path / "real.json").write_text('{"scenes": {"fox": {"version": "0.1.0", "seeds": 1, "cells": []}}}')
    with pytest.raises(InputError, match="another form"):
        read_results(tmp_path / "real.json")


def test_a_page_gets_the_tables_that_it_has_places_for() -> None:
    listed, found = read_real_list(), results()
    short, full = "<!-- real -->\nstale\n<!-- /real -->\n", "<!-- real-full -->\n<!-- /real-full -->\n"
    assert summary_table(listed, found) in (page := with_tables(short, listed, found)) and "stale" not in page
    both = with_tables(short + full, listed, found)
    assert summary_table(listed, found) in both and real_table(listed, found) in both
    assert real_table(listed, found) in with_tables(full, listed, found)
    with pytest.raises(InputError, match="no place"):
        with_tables("# Title\n", listed, found)


def test_pages_are_written_again_without_training(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text("<!-- real -->\n<!-- /real -->\n")
    (tmp_path / "real.json").write_text(results().model_dump_json())
    assert invoke(["real", "-o", str(tmp_path), "--rewrite", "--page", str(page)]) == 3, "fox is missing"
    assert summary_table(read_real_list(), results()) in page.read_text()
    assert invoke(["real", "-o", str(tmp_path / "empty"), "--rewrite", "--page", str(page)]) == 2
    assert "has no results" in capsys.readouterr().err
    assert invoke(["real", "-o", str(tmp_path)]) == 2 and "--captures" in capsys.readouterr().err


@pytest.mark.slow  # two tiny trainings and their evaluations
def test_a_tiny_benchmark_is_resumed_and_names_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    captures, out = tmp_path / "captures", tmp_path / "out"
    make_capture(
        captures / "room", "gs2e-slight", frames=6, width=96, height=54, seed=0, reporter=SilentReporter()
    )
    shutil.rmtree(captures / "room" / "truth")  # a real capture has none
    monkeypatch.setattr(real, "SHOWN", "000001")
    scenes = [
        RealScene(name=real.SHOWCASE, shows="a room", capture="room", settings=SETTINGS, protocol="a room"),
        RealScene(name="fox", shows="a fox", capture="fox", settings=SETTINGS, protocol="absent"),
    ]
    recipe = SceneRecipe(installed(), "default", (), "cpu", 1, EvalOptions(lpips=(), scorers=()), 24)
    with opened_store(out / ".store") as store:
        found = run_scenes(out, captures, scenes, ["all-view", "full"], 1, recipe, store, SilentReporter())
        trained = [path.stat().st_mtime_ns for path in sorted((out / ".store").rglob("scene.ply"))]
        again = run_scenes(out, captures, scenes, ["all-view", "full"], 1, recipe, store, SilentReporter())
    assert [one.variant for one in found.cells] == ["all-view", "full"]
    assert all(one.means["psnr_refined"] is not None for one in found.cells)
    assert len(found.failures) == 1 and "does not exist" in found.failures[0]
    assert again.cells == [one.model_copy(update=_times(one, again)) for one in found.cells]
    assert trained == [path.stat().st_mtime_ns for path in sorted((out / ".store").rglob("scene.ply"))]
    assert showcase(tmp_path / "row.jpg", out, found)
    row = read_rgb(tmp_path / "row.jpg")
    assert row.shape[1] == 4 * 480 + 3 * 4
    pictures = [row[30:, left : left + 480] for left in range(0, row.shape[1], 484)]
    assert all(picture.std() > 20 for picture in pictures)  # an empty place has one colour


def _times(cell: Cell, others: Comparison) -> dict[str, float]:
    """Times of the same cell in ``others``: which variant a shared stage is charged to may differ."""
    other = next(one for one in others.cells if one.variant == cell.variant)
    return {"seconds": other.seconds, "shared_seconds": other.shared_seconds}
