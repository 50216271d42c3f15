"""A scene that was edited by hand comes back: ``--scene`` of export, render and report."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_model import write_sparse
from report_run import FinishedRun

from cleargs.cli.main import invoke
from cleargs.media.image import read_rgb
from cleargs.splat.formats import write_scene
from cleargs.splat.ply import read_ply
from cleargs.splat.scene import Scene
from cleargs.splat.transforms import transform_scene


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    run = FinishedRun(tmp_path_factory.mktemp("edited"))
    write_sparse(run.folder / "ingest")
    return run


@pytest.fixture
def left(run: FinishedRun) -> Scene:
    """The left half of the scene, as an editor leaves it: without the comments of ClearGS."""
    scene = run.scenes["consolidate"]
    half = scene.gaussians.select(scene.gaussians.means[:, 0] < 0.0)
    return Scene(half)


@pytest.mark.parametrize("kind", ["ply", "compressed.ply", "sog"])
def test_an_edited_scene_is_exported_at_the_place_of_the_run(
    run: FinishedRun, left: Scene, kind: str, tmp_path: Path
) -> None:
    edited = tmp_path / f"edited.{kind}"
    write_scene(edited, left, kind)
    arguments = [str(run.folder), "--scene", str(edited), "--metres", "0-2=4", "--cameras"]
    assert invoke(["export", *arguments, "-o", str(tmp_path / "out.ply")]) == 0
    cameras = json.loads((tmp_path / "out.cameras.json").read_text())
    assert np.linalg.norm(np.subtract(cameras[0]["position"], cameras[2]["position"])) == pytest.approx(4.0)
    means = read_ply(tmp_path / "out.ply").gaussians.means
    assert len(means) == left.gaussians.num and float(means[:, 0].max()) < 0.1


def test_films_and_the_report_show_it(
    run: FinishedRun, left: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(tmp_path / "edited.ply", left, "ply")
    scene = ["--scene", str(tmp_path / "edited.ply")]
    assert invoke(["render", str(run.folder), *scene, "--frame", "3", "-o", str(tmp_path / "a.png")]) == 0
    assert "edited.ply" in capsys.readouterr().out, "it named the stage"
    image = read_rgb(tmp_path / "a.png").astype(float)
    half = image.shape[1] // 2
    assert image[:, : half - 5].mean() > 60 and image[:, half + 5 :].mean() < 20
    page = tmp_path / "one.html"
    assert invoke(["report", str(run.folder), *scene, "--single-file", "-o", str(page)]) == 0
    text = (run.folder / "report/index.html").read_text()
    assert "edited scene edited.ply" in text and 'download="run.ply"' not in text
    assert f"{left.gaussians.num:,} Gaussians" in text
    assert "edited scene edited.ply" in page.read_text()
    assert invoke(["report", str(run.folder)]) == 0
    assert not re.search("edited", (run.folder / "report/index.html").read_text())


def test_a_scene_at_another_place_is_refused(
    run: FinishedRun, left: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    turned = transform_scene(left, scale=1.0, rotation=np.diag([1.0, -1.0, -1.0]), translation=np.zeros(3))
    larger = transform_scene(left, scale=2.0, rotation=np.eye(3), translation=np.zeros(3))
    empty = replace(left, gaussians=left.gaussians.select(torch.zeros(left.gaussians.num, dtype=torch.bool)))
    for scene in (turned, larger, empty):
        write_scene(tmp_path / "edited.ply", scene, "ply")
        arguments = ["-o", str(tmp_path / "a.ply"), "--scene", str(tmp_path / "edited.ply")]
        assert invoke(["export", str(run.folder), *arguments]) == 2
        assert "keep its axes" in capsys.readouterr().err or scene is empty
    assert not (tmp_path / "a.ply").exists()
    both = ["export", str(tmp_path / "edited.ply"), "--scene", str(tmp_path / "edited.ply")]
    assert invoke([*both, "-o", str(tmp_path / "a.ply")]) == 2
    over = ["export", str(run.folder), "--scene", str(tmp_path / "edited.ply"), "--force"]
    assert invoke([*over, "-o", str(tmp_path / "edited.ply")]) == 2  # it is an input
