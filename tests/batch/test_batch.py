"""`cleargs batch`: sheets, the loop over their scenes, summary and page."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from toy_batch import ToyBatch

from cleargs.batch import loop
from cleargs.batch.loop import Batch, program
from cleargs.batch.sheet import SceneJob, SheetError, read_scenes
from cleargs.cli.main import invoke
from cleargs.errors import InputError


def read(folder: Path, name: str, text: str) -> list[SceneJob]:
    (folder / name).write_text(text)
    return read_scenes(folder / name)


TOML = """\
recipe = "mine.toml"
[set]
count.limit = 5

[[scene]]
name = "attic"
input = "attic.mp4"

[[scene]]
name = "barn"
input = "/barn"
recipe = "smoke"
set.count.mode = "padded"
set.count.list = [1, 2]
"""

CSV = """\
\ufeffname,input,recipe,count.limit,count.mode,count.list,\r
attic,attic.mp4,mine.toml,5,,,\r
,,,,,,\r
barn,/barn,smoke,5,"""


@pytest.mark.parametrize(
    ("sheet", "capture"), [("summary.csv", "a"), ("s.csv", "report/a"), ("s.csv", "logs")]
)
def test_a_batch_does_not_replace_its_sheet_or_captures(
    sheet: str, capture: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / capture).mkdir(parents=True)
    (tmp_path / capture / "1.txt").write_text("1")
    (tmp_path / sheet).write_text(text := f"name,input\na,{capture}\n")
    dag = ToyBatch(tmp_path).dag
    assert invoke(["batch", str(tmp_path / sheet), "-o", str(tmp_path), "--device", "cpu"], dag) == 2
    assert "the batch would replace" in capsys.readouterr().err
    assert (tmp_path / sheet).read_text() == text and (tmp_path / capture / "1.txt").exists()


@pytest.mark.parametrize(("name", "text"), [("s.toml", TOML), ("s.csv", CSV + 'padded,"[1, 2]",\r\n')])
def test_toml_and_csv_sheets_are_equivalent(tmp_path: Path, name: str, text: str) -> None:
    attic, barn = read(tmp_path, name, text)
    assert (attic.name, attic.source) == ("attic", tmp_path / "attic.mp4")
    assert (attic.recipe, attic.overrides) == (str(tmp_path / "mine.toml"), ("count.limit=5",))
    assert (barn.source, barn.recipe) == (Path("/barn"), "smoke")
    assert [text.replace('"', "") for text in barn.overrides] == [
        "count.limit=5",
        "count.mode=padded",
        "count.list=[1, 2]",
    ]


MISTAKES = {
    "s.csv": [
        ("name,input\na b,x\n,x\n", ["line 2: the name 'a b'", "line 3: the scene has no name"]),
        ("name,input\na,x\na,y\nb,\n", ["line 3: s.csv, line 2 already has the name 'a'", "line 4"]),
        ('name,input\n"a,x\nb,y\n', ["line 3: this is not valid CSV"]),
    ],
    "s.toml": [
        ('[[scene]]\nname="a"\nimput="x"', ["scene a: the scene has no input", "no field 'imput'"]),
        (f'[[scene]]\ninput="x"\n[[scene]]\nname="{"n" * 101}"\ninput=" "', ["scene 1", "100", "input"]),
        ('[[scene]]\nname="a"\ninput="x"\nset=3', ["scene a: set"]),
    ],
}


@pytest.mark.parametrize(
    ("name", "text", "problems"), [(name, *case) for name, cases in MISTAKES.items() for case in cases]
)
def test_mistakes_are_named_with_their_place(
    tmp_path: Path, name: str, text: str, problems: list[str]
) -> None:
    with pytest.raises(SheetError) as caught:
        read(tmp_path, name, text)
    assert len(caught.value.problems) == len(problems)
    assert all(said in problem for said, problem in zip(problems, caught.value.problems, strict=True))


@pytest.mark.parametrize("text", ["", "[[scene", "scene = 3"])
def test_an_invalid_toml_sheet_is_one_error(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError):
        read(tmp_path, "s.toml", text)


@pytest.mark.parametrize("text", ["name;input\na;x\n", "name,input,input\na,x,y\n", "\n"])
def test_an_invalid_csv_sheet_is_one_error(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError):
        read(tmp_path, "s.csv", text)


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("nowhere.mp4,,", "nowhere.mp4 does not exist"),
        ("hall.mp4,0,", "g0.steps = 0 cannot be used"),
        ("hall.mp4,,nonesuch", "there is no expert 'nonesuch'"),
        ("hall.mp4,,nafnet-gopro", "nafnet-gopro is not installed"),
        ("hall.mp4,,,surplus", "more cells than columns"),
    ],
)
def test_a_wrong_scene_starts_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, row: str, said: str
) -> None:
    monkeypatch.setenv("CLEARGS_MODELS", str(tmp_path / "models"))
    (tmp_path / "hall.mp4").touch()
    sheet = tmp_path / "sheet.csv"
    sheet.write_text(f"name,input,g0.steps,rivr.expert\nhall,{row}\n")
    assert invoke(["batch", str(sheet)]) == 2
    assert said in capsys.readouterr().err.splitlines()[0]
    assert not (tmp_path / "sheet.batch").exists()


def test_a_folder_of_another_input_is_refused(toys: ToyBatch, capsys: pytest.CaptureFixture[str]) -> None:
    run = toys.folder / "scenes" / "barn"
    run.mkdir(parents=True)
    (run / "run.toml").write_text('input = "/elsewhere/hall.mp4"\n')
    assert toys.run() == 2
    assert "scene barn: " in (said := capsys.readouterr().err) and "is a run of /elsewhere/hall.mp4" in said
    assert toys.work_done() == []


def test_a_bad_scene_does_not_stop_the_others(toys: ToyBatch, capsys: pytest.CaptureFixture[str]) -> None:
    (toys.root / "barn" / "11.txt").write_text("no number")  # an error in square
    (toys.root / "cellar" / "20.txt").write_text("")  # count skips it
    assert toys.run("--json") == 1
    streams = capsys.readouterr()
    results = {result["scene"]: result for result in json.loads(streams.out)}
    assert {name: result["state"] for name, result in results.items()} == {
        "attic": "done",
        "barn": "failed",
        "cellar": "partial",
    }
    assert "no number" in results["barn"]["cause"] and "20.txt is empty" in results["cellar"]["cause"]
    assert {name: row["cause"] for name, row in toys.summary().items()} == {
        name: result["cause"] for name, result in results.items()
    }
    assert "attic: square: started" in streams.err
    assert "no number" in (toys.folder / "logs" / "barn.log").read_text()
    page = (toys.folder / "report" / "index.html").read_text()
    assert page.index("barn") < page.index("cellar") < page.index("attic"), "failed scenes come first"
    assert toys.digests("attic") == toys.undisturbed("attic")
    toys.work_done()

    (toys.root / "barn" / "11.txt").write_text("11")
    assert toys.run() == 3
    stages = [line for line in toys.work_done() if line in toys.dag.names]
    assert sorted(stages) == ["count", "count", "square", "total"], "barn, and count of cellar"
    assert toys.digests("barn") == toys.undisturbed("barn")
    assert toys.run("--allow-partial") == 3
    assert toys.summary()["cellar"]["state"] == "partial" and toys.digests("cellar")


def test_a_changed_setting_affects_its_scene_only(toys: ToyBatch) -> None:
    toys.write_sheet({"attic": "", "barn": ""})
    assert toys.run() == 0
    toys.work_done()
    toys.write_sheet({"attic": "", "barn": "set.square.power = 3"})
    assert toys.run("--no-report") == 0
    assert [line for line in toys.work_done() if line in toys.dag.names] == ["square", "total"]
    toys.write_sheet({"attic": "", "barn": ""})  # the old results are still in the store
    assert toys.run() == 0
    assert toys.work_done() == []


def test_dry_run_shows_the_cost_and_summary_the_results(
    toys: ToyBatch, capsys: pytest.CaptureFixture[str]
) -> None:
    toys.write_sheet({"attic": "", "barn": ""})
    assert toys.run("--dry-run", "--json") == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["hours"] == pytest.approx(2 * (0.1 + 6.0 + 0.3) / 60, abs=0.002)
    assert (plan["memory_gb"], plan["disk_gb"]) == (0.1, pytest.approx(0.006))
    assert [scene["to_do"] for scene in plan["scenes"]] == [list(toys.dag.names)] * 2
    assert not toys.folder.exists()

    assert invoke(plan["scenes"][0]["command"], toys.dag) == 0
    assert toys.run("--summary") == 1
    assert {name: row["state"] for name, row in toys.summary().items()} == {
        "attic": "done",
        "barn": "waiting",
    }
    assert toys.run("--until", "count", "--dry-run") == 0
    assert "attic: 0.0 s, 0.0 GB memory, 0.00 GB disk; done" in capsys.readouterr().out


def test_dry_run_names_no_stage_without_work(
    toys: ToyBatch, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A draft has no repairs: "to do" listed rivr and consolidate."""
    monkeypatch.setattr(type(toys.dag.load("total")), "idle", lambda stage, config: True, raising=False)
    toys.write_sheet({"attic": ""})
    assert toys.run("--dry-run") == 0
    assert "disk; to do: count, square\n" in capsys.readouterr().out


def test_a_figure_below_its_limit_is_a_failure(toys: ToyBatch, capsys: pytest.CaptureFixture[str]) -> None:
    toys.write_sheet({"attic": ""})
    assert toys.run("--fail-below", "minutes=0", "--no-report") == 0
    capsys.readouterr()
    assert toys.run("--fail-below", "minutes=60", "--no-report") == 1
    assert "below the limit: attic: minutes 0." in capsys.readouterr().err
    assert toys.run("--fail-below", "psnr_unseen=25", "--no-report") == 1, "the toy stages measure none"
    for wrong, words in (("psnr", "form FIGURE=VALUE"), ("psnr=2", "choose one of disk_gb")):
        capsys.readouterr()
        assert toys.run("--fail-below", wrong, "--no-report") == 2 and words in capsys.readouterr().err


def test_work_after_a_scene(toys: ToyBatch) -> None:
    """Exports and films are made once per scene file, and a missing one is not "done"."""
    toys.write_sheet({"attic": 'after.export = ["sog", "blender"]\nafter.render = "turntable"'})
    (scene,) = read_scenes(toys.root / "sheet.toml")
    batch = Batch(toys.dag, toys.folder, [scene], "cpu")
    assert toys.run("--no-report") == 0, "the toy stages make no scene"
    made = batch.run_folder(scene) / "scene.ply"
    made.write_text("a scene")
    run = str(batch.run_folder(scene))
    assert list(batch.arguments_after(scene)) == [
        ["export", run, "-o", "attic.sog", "--force"],
        ["export", run, "--for", "blender", "--force"],
        ["render", run, "-o", "attic.mp4", "--force", "--turntable"],
    ]
    assert batch.result(scene).state == "waiting"
    batch.exports.mkdir()
    for name in ("attic.sog", "attic-blender.ply", "attic.mp4"):
        (batch.exports / name).touch()
    assert not list(batch.arguments_after(scene)) and batch.result(scene).state == "done"
    os.utime(batch.exports / "attic.sog", (1, 1))
    assert [arguments[0] for arguments in batch.arguments_after(scene)] == ["export"]
    toys.write_sheet({"attic": 'after.export = ["splat"]'})
    assert toys.run() == 2


def test_the_export_of_another_scene_with_a_longer_name_is_not_its_own(toys: ToyBatch) -> None:
    toys.write_sheet({"a": 'after.export = ["web"]', "a-web": 'after.export = ["ply"]'})
    scenes = read_scenes(toys.root / "sheet.toml")
    batch = Batch(toys.dag, toys.folder, scenes, "cpu")
    for scene in scenes:
        batch.run_folder(scene).mkdir(parents=True)
        (batch.run_folder(scene) / "scene.ply").write_text("a scene")
    batch.exports.mkdir()
    (batch.exports / "a-web.ply").touch()
    assert [[*batch.arguments_after(scene)] != [] for scene in scenes] == [True, False]


def test_a_killed_batch_resumes_from_its_checkpoint(toys: ToyBatch) -> None:
    sheet = toys.write_sheet({"attic": ""}, held=True)
    code = f"""
import runpy, sys
from cleargs.batch import loop
loop.program = lambda: {toys.program}
sys.argv[1:] = {[toys.program[2], "batch", str(sheet), "--device", "cpu"]}
runpy.run_path({toys.program[1]!r}, run_name="__main__")
"""
    batch = subprocess.Popen([sys.executable, "-c", code])
    toys.wait_until(lambda: "held" in toys.lines(), "held")
    batch.send_signal(signal.SIGTERM)
    assert batch.wait(timeout=60) == 130
    toys.hold.unlink()
    assert toys.run() == 0
    assert toys.lines().count("square 0.txt") == 1, "the checkpoint was used"
    assert toys.digests("attic") == toys.undisturbed("attic")


def test_the_signal_that_killed_a_child_is_reported(toys: ToyBatch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "program", lambda: ["/bin/sh", "-c", "kill -9 $$"])
    toys.write_sheet({"attic": ""})
    assert toys.run() == 1
    assert toys.summary()["attic"]["cause"] == "ended by signal 9"


def test_child_starts_without_a_script_next_to_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scripts may be in another folder, and the working folder may have a file ``json.py``."""
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    (tmp_path / "json.py").write_text("raise SystemExit(7)")
    monkeypatch.setattr(sys, "executable", str(python))
    done = subprocess.run([*program(), "--version"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("cleargs, version "), done.stderr


@pytest.mark.parametrize("name", ["report/thesis.tex", "summary.csv", "exports/a.ply", "logs/barn.log"])
def test_a_folder_with_other_content_is_no_batch(
    toys: ToyBatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    mine = toys.folder / name
    mine.parent.mkdir(parents=True)
    mine.write_text("years of work")
    assert toys.run() == 2 and "is not a batch" in capsys.readouterr().err
    assert mine.read_text() == "years of work" and len(list(toys.folder.iterdir())) == 1


def test_exports_of_the_user_next_to_runs_are_not_replaced(
    toys: ToyBatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert toys.run() == 0
    (toys.folder / "summary.csv").unlink()
    mine = toys.folder / "exports" / "barn.ply"
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("years of work")
    capsys.readouterr()
    assert toys.run() == 2 and "exports was not made by a batch; it has" in capsys.readouterr().err
    assert mine.read_text() == "years of work"


def test_links_in_a_batch_are_refused(toys: ToyBatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert toys.run() == 0
    for name in ("scenes", "logs", "logs/barn.log", "scenes/barn", "exports", "summary.csv"):
        place, goal = toys.folder / name, toys.folder.parent / "outside"
        was = place.exists()
        if was:
            place.rename(goal)
        else:
            goal.mkdir()
        place.symlink_to(goal)
        before = {path: path.stat().st_mtime_ns for path in (goal, *goal.rglob("*"))}
        capsys.readouterr()
        assert toys.run() in (1, 2) and "is a link" in capsys.readouterr().err, name
        assert {path: path.stat().st_mtime_ns for path in (goal, *goal.rglob("*"))} == before, name
        place.unlink()
        if was:
            goal.rename(place)
        else:
            goal.rmdir()
