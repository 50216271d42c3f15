"""No command and no function replaces an input of a run, or a file of the run, also with --force."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from colmap_model import write_no_formation, write_sparse
from report_run import FinishedRun

import cleargs as cg
from cleargs.cli.main import invoke
from cleargs.digest import file_digest
from cleargs.errors import InputError
from cleargs.pipeline.config import load_config
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.run_file import write_run_file
from cleargs.pipeline.stages import installed

COMMANDS: dict[str, tuple[str, Callable[[Path], list[str]]]] = {
    "export": ("ply", lambda file: ["export", "RUN", "-o", str(file), "--force"]),
    "export for": ("spz", lambda file: ["export", "RUN", "--for", "web", "-o", str(file), "--force"]),
    "film": ("mp4", lambda file: ["render", "RUN", "-o", str(file), "--seconds", "0.1", "--force"]),
    "still": ("png", lambda file: ["render", "RUN", "-o", str(file), "--force"]),
    "exr": ("exr", lambda file: ["render", "RUN", "-o", str(file), "--frame", "3", "--force"]),
    "pack": ("zip", lambda file: ["pack", "RUN", "-o", str(file), "--force"]),
    "report": ("html", lambda file: ["report", "RUN", "--single-file", "-o", str(file)]),
    "show": ("png", lambda file: ["show", "RUN", "--frame", "3", "-o", str(file)]),
    "eval": ("json", lambda file: ["eval", "RUN", "--reference", str(file.parent), "-o", str(file)]),
    "log": ("txt", lambda file: ["export", "RUN", "-o", "NEW.ply", "--log", str(file)]),
}
"""Command -> ending of its output, and its arguments for an output."""

FUNCTIONS: dict[str, tuple[str, Callable[[cg.Run, Path], object]]] = {
    "export": ("ply", lambda run, file: cg.export(run, file, force=True)),
    "film": ("mp4", lambda run, file: cg.film(run, file, seconds=0.1)),
    "save": ("spz", lambda run, file: cg.save(run.scene(), file)),
    "train": ("bin", lambda run, file: cg.train(run.scene(), [], checkpoint=file)),
    "nerfstudio": ("x", lambda run, file: cg.open_prepared(run["ingest"]).to_nerfstudio(file)),
}
"""Function of the library -> ending of its output, and a call."""

ENDINGS = sorted({ending for ending, _ in (*COMMANDS.values(), *FUNCTIONS.values())})


@pytest.fixture
def run(tmp_path: Path) -> FinishedRun:
    """A run with a folder of files as its capture, and an expert that is an ONNX file."""
    made = FinishedRun(tmp_path, name="room-scene")
    write_sparse(made.folder / "ingest")
    write_no_formation(made.folder / "consolidate")
    capture = tmp_path / "room"
    (capture / "images").mkdir(parents=True)
    for ending in ENDINGS:
        (capture / f"images/input.{ending}").write_text(f"the only {ending}")
    (tmp_path / "models").mkdir()
    (tmp_path / "models/expert.onnx").write_text("a network")
    config = load_config(made.dag, "smoke", [f"rivr.expert={tmp_path / 'models/expert.onnx'}"])
    made.run = replace(made.run, source=capture, config=config)
    write_run_file(made.run)
    return made


def snapshot(folder: Path) -> dict[str, str]:
    """Digest of every file, also of hidden ones, except logs."""
    files = (file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): file_digest(file) for file in files}


def targets(run: FinishedRun, ending: str) -> list[Path]:
    """Paths that must not be written, with this ending."""
    root, source = run.folder.parent, run.run.source / f"images/input.{ending}"
    (root / "links").mkdir(exist_ok=True)
    soft, hard, up = (root / f"links/{name}.{ending}" for name in ("soft", "hard", "up"))
    for link in (soft, hard, up):
        link.unlink(missing_ok=True)
    soft.symlink_to(source)
    os.link(source, hard)
    up.symlink_to(soft)
    (root / "room-link").unlink(missing_ok=True)
    (root / "room-link").symlink_to(run.run.source)
    return [
        source,
        run.run.source / "images" / ".." / "images" / source.name,
        soft,
        hard,
        up,
        run.run.source / f"new.{ending}",
        root / f"room-link/images/{source.name}",
        run.folder / f"consolidate/new.{ending}",
        run.folder / f"report/new.{ending}",
        run.folder / f".store/new.{ending}",
    ]


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_replaces_an_input(
    run: FinishedRun, name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run.folder.parent)
    ending, arguments = COMMANDS[name]
    for file in targets(run, ending):
        before = snapshot(run.folder.parent)
        words = [str(run.folder) if word == "RUN" else word for word in arguments(file)]
        assert invoke(words) == 2, file
        assert "never replaced" in capsys.readouterr().err, file
        assert snapshot(run.folder.parent) == before, file


@pytest.mark.parametrize("name", FUNCTIONS)
def test_no_function_replaces_an_input(run: FinishedRun, name: str) -> None:
    ending, call = FUNCTIONS[name]
    for file in targets(run, ending):
        if not file.exists() and name in ("save", "train") and run.run.source in file.parents:
            continue  # these know no run, so they only keep what exists
        before = snapshot(run.folder.parent)
        with pytest.raises(InputError, match="never replaced"):
            call(cg.open_run(run.folder), file)
        assert snapshot(run.folder.parent) == before, file


@pytest.mark.parametrize(
    "name", ["run.toml", "scene.ply", "report.html", "run.log", "g0", "consolidate/scene.ply"]
)
def test_the_files_of_a_run_are_part_of_it(run: FinishedRun, name: str) -> None:
    with pytest.raises(InputError, match=f"part of the run {run.folder}"):
        check_outputs([run.folder / name], installed(), run.folder)
    with pytest.raises(InputError, match="part of the run"):
        check_outputs([run.folder / name], installed())  # also for a command without a run
    check_outputs([run.folder / "film.mp4", run.folder / "frame-000003.png"], installed(), run.folder)


def test_models_and_sidecars_are_inputs_too(run: FinishedRun, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="an input of the run"):
        check_outputs([tmp_path / "models/expert.onnx"], installed(), run.folder)
    cameras = tmp_path / "a.cameras.json"
    cameras.symlink_to(run.run.source / "images/input.json")
    words = ["export", str(run.folder), "-o", str(tmp_path / "a.ply"), "--cameras", "--force"]
    assert invoke(words) == 2
    cameras.unlink()
    (tmp_path / "a.cameras.json").symlink_to(tmp_path / "other.json")
    (tmp_path / "other.json").write_text("mine")
    assert invoke(words) == 0
    assert (tmp_path / "other.json").read_text() == "mine", "a link is replaced, not written through"


def test_an_input_that_was_moved_is_known_by_its_recorded_path(run: FinishedRun, tmp_path: Path) -> None:
    video = tmp_path / "walk.mp4"
    write_run_file(replace(run.run, source=video))
    assert invoke(["render", str(run.folder), "-o", str(video), "--seconds", "0.1"]) == 2
    assert not video.exists()


def test_the_only_recording_survives_the_film_of_another_run(run: FinishedRun, tmp_path: Path) -> None:
    video = tmp_path / "walk.mp4"
    video.write_text("the only recording")
    write_run_file(replace(run.run, source=video, folder=tmp_path / "walk"))
    with pytest.raises(InputError, match=f"an input of the run {tmp_path / 'walk'}"):
        check_outputs([video], installed(), run.folder)


def test_eval_keeps_references_and_foreign_results(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reference = tmp_path / "reference"
    (reference / "images").mkdir(parents=True)
    (reference / "transforms.json").write_text("{}")
    words = ["eval", str(run.folder), "--reference", str(reference)]
    assert invoke([*words, "--save-renders", str(reference / "images")]) == 2
    assert "an input of this command" in capsys.readouterr().err
    (tmp_path / "mine.json").write_text(json.dumps({"mine": 1}))
    assert invoke([*words, "-o", str(tmp_path / "mine.json")]) == 2
    (tmp_path / "table.parquet").write_text("mine")
    assert invoke([*words, "-o", str(tmp_path / "table.json")]) == 2
    assert (tmp_path / "mine.json").read_text() == '{"mine": 1}'
    assert (tmp_path / "table.parquet").read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "name", "told"),
    [
        (["show", "RUN", "--frame", "3", "-o", "mine/a.png"], "a.png", "exists already"),
        (["report", "RUN", "--single-file", "-o", "mine/a.html"], "a.html", "is not a report"),
        (["eval", "RUN", "--reference", "x", "--save-renders", "mine"], "000000.png", "mine is not empty"),
    ],
)
def test_other_files_are_not_replaced(
    run: FinishedRun,
    words: list[str],
    name: str,
    told: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(run.folder.parent)
    Path("mine").mkdir()
    Path("mine", name).write_text("years of work")
    words = [str(run.folder) if word == "RUN" else word for word in words]
    assert invoke(words) == 2 and told in capsys.readouterr().err
    assert Path("mine", name).read_text() == "years of work"
    if words[0] == "show":
        assert invoke([*words, "--force"]) == 0
    if words[0] == "report":
        Path("mine", name).unlink()
        assert invoke(words) == invoke(words) == 0, "a report replaces a report"


def test_links_that_lead_nowhere_or_in_circles(run: FinishedRun, tmp_path: Path) -> None:
    (tmp_path / "circle.ply").symlink_to(tmp_path / "circle.ply")
    (tmp_path / "gone.ply").symlink_to(tmp_path / "absent" / "a.ply")
    (run.run.source / "images/circle.png").symlink_to("circle.png")
    check_outputs([tmp_path / "circle.ply", tmp_path / "gone.ply"], installed(), run.folder)
    (tmp_path / "new.ply").symlink_to(run.run.source / "new.ply")
    with pytest.raises(InputError, match="an input of the run"):
        check_outputs([tmp_path / "new.ply"], installed(), run.folder)


def test_a_run_inside_its_capture_can_be_exported_next_to_it(run: FinishedRun, tmp_path: Path) -> None:
    """Only what is read counts then: otherwise no place in the working directory would be left."""
    (tmp_path / "images").mkdir()
    (tmp_path / "images/a.png").write_text("a frame")
    write_run_file(replace(run.run, source=tmp_path))
    check_outputs([tmp_path / "new.ply"], installed(), run.folder)
    with pytest.raises(InputError, match="an input of the run"):
        check_outputs([tmp_path / "images/new.png"], installed(), run.folder)


def test_a_log_is_only_appended_to_logs(run: FinishedRun, tmp_path: Path) -> None:
    log = tmp_path / "mine.log"
    words = ["export", str(run.folder), "-o", str(tmp_path / "a.ply"), "--force", "--log", str(log)]
    assert invoke([*words, "--prune", "opacity:0.1"]) == invoke([*words, "--prune", "opacity:0.2"]) == 0
    assert log.stat().st_size > 0
    log.write_text("dear diary")
    assert invoke(words) == 2
    assert log.read_text() == "dear diary"


def test_a_demo_and_a_synthetic_capture_need_a_new_folder(run: FinishedRun) -> None:
    before = snapshot(run.folder.parent)
    for words in (["demo", "-o"], ["synth"]):
        assert invoke([*words, str(run.run.source)]) == 2
    assert snapshot(run.folder.parent) == before
