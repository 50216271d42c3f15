"""``cleargs export`` of a whole run: worlds, endings, and what is there already."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from report_run import FinishedRun

from cleargs.cli.main import invoke
from cleargs.splat.formats import FORMATS
from cleargs.splat.ply import read_ply


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    return FinishedRun(tmp_path_factory.mktemp("export"))


def export(run: FinishedRun, output: Path, *arguments: str) -> int:
    return invoke(["export", str(run.folder), "-o", str(output), *arguments])


@pytest.mark.parametrize("kind", [kind for kind in FORMATS if kind != "usdc"])
def test_every_format_in_both_worlds(run: FinishedRun, kind: str, tmp_path: Path) -> None:
    assert export(run, tmp_path / f"here.{kind}") == 0
    assert export(run, tmp_path / f"there.{kind}", "--world", "input") == 0
    here, there = ((tmp_path / f"{name}.{kind}").read_bytes() for name in ("here", "there"))
    assert here != there
    cameras = [json.loads((tmp_path / f"{name}.cameras.json").read_text()) for name in ("here", "there")]
    assert len(cameras[0]) == 6  # the placed frames
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # as the run notes it
    moved = 2.5 * turn @ cameras[0][2]["position"] + [1.0, -2.0, 3.0]
    assert np.allclose(cameras[1][2]["position"], moved)


def test_degree_three_for_the_inria_code(run: FinishedRun, tmp_path: Path) -> None:
    assert export(run, tmp_path / "a.ply", "--sh-degree", "3") == 0
    assert read_ply(tmp_path / "a.ply").gaussians.sh_degree == 3
    assert export(run, tmp_path / "b.ply", "--sh-degree", "0") == 2 and not (tmp_path / "b.ply").exists()


def test_nothing_is_overwritten_unasked(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.ply").write_text("mine")
    assert export(run, tmp_path / "a.ply") == 2 and "give --force" in capsys.readouterr().err
    assert (tmp_path / "a.ply").read_text() == "mine" and not (tmp_path / "a.cameras.json").exists()
    assert export(run, tmp_path / "a.ply", "--force") == 0
    (tmp_path / "a.ply").unlink()
    assert export(run, tmp_path / "a.ply") == 2  # the cameras are still there


def test_an_unknown_ending_writes_nothing(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(run, tmp_path / "room.splat") == 2
    assert ".compressed.ply" in capsys.readouterr().err and not list(tmp_path.iterdir())
