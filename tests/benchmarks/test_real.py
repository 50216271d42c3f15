"""`python -m benchmarks real`: its list, its table, and a tiny benchmark that is resumed."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from benchmarks.comparison import real
from benchmarks.comparison.cells import Cell
from benchmarks.comparison.findings import Comparison
from benchmarks.comparison.real import (
    RealScene,
    find_scenes,
    read_real_list,
    real_table,
    run_scenes,
    showcase,
    table_of,
    with_table,
)
from benchmarks.comparison.scenes import SceneRecipe
from cleargs.errors import InputError
from cleargs.evaluate.config import EvalOptions
from cleargs.media.image import read_rgb
from cleargs.pipeline.config import load_config
from cleargs.pipeline.dag import installed
from cleargs.pipeline.session import opened_store
from cleargs.progress import SilentReporter
from cleargs.synth.synthetic_capture import make_capture

SETTINGS = ("g0.min_points=400", "g0.budget=500", "ingest.max_features=512", "ingest.holdout=every:3")


def cell(variant: str, seed: int, psnr: float) -> Cell:
    return Cell(
        column="blurball",
        sample=f"blurball-{seed}",
        variant=variant,
        views="held-out",
        means={"psnr": psnr, "ssim": 0.8, "lpips_alex": 0.2, real.REFINED: psnr + 0.5},
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


def test_the_list_has_valid_settings_and_names_its_sources() -> None:
    listed = read_real_list()
    assert [scene.name for scene in listed.scenes] == ["blurball", "kitchen", "office", "fox", "bonsai"]
    for scene in listed.scenes:
        config = load_config(installed(), "default", scene.settings, 0)
        assert config.sections["ingest"].holdout != "none"  # type: ignore[attr-defined]
    assert all(one.source and one.protocol for one in listed.published)
    with pytest.raises(InputError, match="kitchn"):
        find_scenes(listed, ["kitchn"])


def test_the_table_has_means_over_seeds_and_published_figures() -> None:
    found = Comparison(cells=[cell("full", 0, 29.0), cell("full", 1, 31.0)], failures=["fox: it is missing"])
    table = real_table(read_real_list(), found)
    assert (
        "| blurball | ClearGS | 30.00 ± 1.41 | 30.50 ± 1.41 | 0.800 ± 0.000 | 0.200 ± 0.000 | 2.0 |" in table
    )
    assert "| blurball | *Deblur-NeRF, 200,000 iterations* | 27.33 | - | 0.770 | 0.223 | - |" in table
    second_hand = [line for line in table.splitlines() if "CoMoGaussian" in line and line.startswith("|")]
    assert len(second_hand) == 1 and "* * |" in second_hand[0]
    assert "Not made: fox: it is missing." in table and "blurball: Deblur-NeRF's real scene" in table


def test_the_table_goes_between_its_lines_and_is_found_there() -> None:
    page = "# Title\n\n<!-- real -->\nold\n<!-- /real -->\n\nrest\n"
    new = with_table(page, "| a |")
    assert new == "# Title\n\n<!-- real -->\n\n| a |\n\n<!-- /real -->\n\nrest\n"
    assert table_of(new) == "| a |" and with_table(new, "| a |") == new
    with pytest.raises(InputError, match="no place"):
        with_table("# Title\n", "| a |")


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
        RealScene(name=real.SHOWCASE, capture="room", settings=SETTINGS, protocol="a room"),
        RealScene(name="fox", capture="fox", settings=SETTINGS, protocol="absent"),
    ]
    recipe = SceneRecipe(installed(), "default", (), "cpu", 1, EvalOptions(lpips=(), scorers=()), 24)
    with opened_store(out / ".store") as store:
        found = run_scenes(out, captures, scenes, ["all-view", "full"], 1, recipe, store, SilentReporter())
        trained = [path.stat().st_mtime_ns for path in sorted((out / ".store").rglob("scene.ply"))]
        again = run_scenes(out, captures, scenes, ["all-view", "full"], 1, recipe, store, SilentReporter())
    assert [one.variant for one in found.cells] == ["all-view", "full"]
    assert all(one.means[real.REFINED] is not None for one in found.cells)
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
