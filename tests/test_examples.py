"""All examples run unchanged on a tiny capture."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

import pytest

import cleargs as cg
from cleargs.progress import SilentReporter
from cleargs.synth.synthetic_capture import make_capture

EXAMPLES = Path(__file__).parents[1] / "examples"

TINY = """\
[g0]
steps = 30
min_points = 300
budget = 400

[rivr]
rounds = 1
distil.steps = 5

[consolidate]
distil.steps = 5
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with a capture of eight frames, a recipe and a run."""
    folder = tmp_path_factory.mktemp("examples")
    make_capture(folder / "room", "mixed", frames=8, width=96, height=54, seed=0, reporter=SilentReporter())
    (folder / "tiny.toml").write_text(TINY)
    cg.run(folder / "room", folder / "run", workflow=str(folder / "tiny.toml"))
    return folder


def example(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: object
) -> str:
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_run_and_read(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = (place / "room", place / "run", place / "tiny.toml")
    out = example("run_and_read.py", monkeypatch, capsys, *arguments)
    assert "consolidate {" in out and "weight" in out and out.rstrip().endswith("Gaussians")


def test_train_a_scene(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = place / "own.ply"
    example("train_a_scene.py", monkeypatch, capsys, place / "run", made, 20)
    assert cg.load(made).gaussians.num >= 5000 and cg.load(made).gaussians.sh_degree == 1


def test_judge_frames(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = example("judge_frames.py", monkeypatch, capsys, place / "room" / "images", place / "best.png")
    assert out.count("reliability") == 8 and (place / "best.png").is_file()


def test_deblur_a_frame(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = example("deblur_a_frame.py", monkeypatch, capsys, place / "run", 3, place / "frame.png")
    assert ("explains" in out) != (place / "frame.png").is_file()


def test_evaluate_scenes(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = (place / "run", place / "room" / "truth" / "observed")
    out = example("evaluate_scenes.py", monkeypatch, capsys, *arguments)
    assert [line.split()[0] for line in out.splitlines()] == ["g0", "rivr", "consolidate"]
    assert all("psnr" in line for line in out.splitlines())


def test_the_notebook(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs the cells one after the other, without Jupyter."""
    monkeypatch.setenv("MPLBACKEND", "Agg")
    notebook = json.loads((EXAMPLES / "walkthrough.ipynb").read_text())
    code = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    names: dict[str, object] = {}
    exec(code[0], names)
    names.update(CAPTURE=place / "room", RUN=place / "run", WORKFLOW=str(place / "tiny.toml"))
    for cell in code[1:]:
        exec(cell, names)
    assert isinstance(names["scene"], cg.Scene)
