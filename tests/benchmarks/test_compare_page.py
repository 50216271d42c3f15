"""The page of a comparison of two finished runs, with names that could break it."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from compared_runs import HOSTILE, compare_runs
from pages import Page, assert_offline

from benchmarks.comparison.findings import Comparison
from benchmarks.comparison.page import write_comparison

CAPTURE = "gone & <away>"
WARNING = "note: </script><script>window.hacked = 2</script>"


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Comparison]:
    return compare_runs(tmp_path_factory.mktemp("compare"))


@pytest.fixture(scope="module")
def page(compared: tuple[Path, Comparison]) -> Path:
    out, found = compared
    return write_comparison(out, found, [HOSTILE], ["device cpu"], [WARNING])


def test_page_needs_no_other_files(page: Path) -> None:
    assert page.name == "index.html" and page.parent.name == "report"
    assert_offline(page)
    assert [path.name for path in page.parent.parent.iterdir() if "partial" in path.name] == []
    size = sum(file.stat().st_size for file in page.parent.rglob("*"))
    assert size < 1_000_000  # 9 small pictures and a page


def test_losses_come_first_with_a_note_on_one_sample(page: Path) -> None:
    text = Page(page.read_text()).text
    # The frames are renders of the scene of "second", so its PSNR and SSIM are much better.
    assert "second is worse in 0 of 2 comparisons." in text
    places = [
        text.index(part)
        for part in ("Comparisons in which second is worse", "Poses are evenly spaced", "SH degree")
    ]
    assert places == sorted(places)
    assert "so a small difference may be chance" in text
    assert "No scene was trained on these frames" in text
    assert "Steps or SH degree differ between variants" in text  # 180 steps and 90


def test_variants_are_shown_at_the_same_poses(page: Path, compared: tuple[Path, Comparison]) -> None:
    data = json.loads(re.search(r'id="data">(.*?)</script>', page.read_text(), re.S)[1])
    assert data["layers"] == {"reference": "Reference", "filmed": "As filmed", "v0": HOSTILE, "v1": "second"}
    assert data["opening"] == {"left": "reference", "right": "v1"}
    assert [pose["title"] for pose in data["frames"]] == [f"{CAPTURE} · {name}" for name in names(data)]
    assert len(set(names(data))) == 3
    for pose in data["frames"]:
        assert list(pose["layers"]) == ["reference", "v0", "v1"]  # the filmed frame is the reference
        (metric, psnr), (other, _) = pose["figures"]
        assert metric.startswith("PSNR") and other.startswith("SSIM")
        assert pose["notes"]["v0"] == f"{dict(psnr)[HOSTILE]} dB"
        assert float(dict(psnr)["second"]) > float(dict(psnr)[HOSTILE]) + 5.0  # the frames are its renders


def names(data: dict) -> list[str]:
    return [pose["title"].removeprefix(f"{CAPTURE} · ") for pose in data["frames"]]


def test_hostile_names_stay_text(page: Path) -> None:
    parsed = Page(page.read_text())
    assert HOSTILE in parsed.text and CAPTURE in parsed.text and WARNING in parsed.text
    assert len(parsed.all("script")) == 2


def test_scenes_of_other_seeds_are_not_subtracted(tmp_path: Path, compared: tuple[Path, Comparison]) -> None:
    out, found = compared
    shutil.copytree(out / "evaluations", tmp_path / "evaluations")
    first, second = found.scenes
    other = replace(second, sample=replace(second.sample, seed=1))
    cells = [found.cells[0], found.cells[1].model_copy(update={"sample": other.sample.name})]
    text = write_comparison(
        tmp_path, Comparison([first, other], cells, found.roles), [HOSTILE], [], []
    ).read_text()
    assert "2 scenes without common samples." in text and "Differences need scenes" in text
    data = json.loads(re.search(r'id="data">(.*?)</script>', text, re.S)[1])
    assert all(list(pose["layers"]) == ["reference", "v0", "v1"] for pose in data["frames"])


def test_page_of_a_single_scene(tmp_path: Path, compared: tuple[Path, Comparison]) -> None:
    out, found = compared
    shutil.copytree(out / "evaluations", tmp_path / "evaluations")
    single = Comparison(found.scenes[:1], found.cells[:1], found.roles[:1])
    text = write_comparison(tmp_path, single, [HOSTILE], [], []).read_text()
    assert "Add another variant or run" in text and 'id="losses"' not in text
