"""The command line for users: exit codes, errors of two lines, results on stdout."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Literal

import click
import numpy as np
import pytest
from toy import Bench

from cleargs.cli import doctor
from cleargs.cli.doctor import device_of
from cleargs.cli.main import COMMANDS, cli, explanation, invoke
from cleargs.cli.outcome_lines import outcome_lines
from cleargs.cli.progress_bars import make_reporter
from cleargs.cli.run import without_effect
from cleargs.gpu import Check, Machine, SelfTest
from cleargs.manifest import FileRecord, KeyParts, Manifest
from cleargs.media.encode import write_video
from cleargs.pipeline import session
from cleargs.pipeline.config import load_config
from cleargs.pipeline.runner import StageOutcome
from cleargs.pipeline.session import default_folder, usable_cores
from cleargs.pipeline.stages import installed


@pytest.fixture
def recipe(bench: Bench) -> str:
    path = bench.root / "empty.toml"
    path.touch()
    return str(path)


class Shell:
    """Calls commands on the toy pipeline."""

    def __init__(self, bench: Bench, recipe: str, capsys: pytest.CaptureFixture[str]) -> None:
        self.bench = bench
        self.recipe = recipe
        self.capsys = capsys

    def __call__(self, *arguments: str) -> tuple[int, str, str]:
        code = invoke(list(arguments), self.bench.dag)
        streams = self.capsys.readouterr()
        return code, streams.out, streams.err

    def run(self, *arguments: str) -> tuple[int, str, str]:
        capture, folder = str(self.bench.capture), str(self.bench.folder)
        return self("run", capture, "-o", folder, "--workflow", self.recipe, *arguments)


@pytest.fixture
def shell(
    bench: Bench, recipe: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Shell:
    monkeypatch.delenv("CLEARGS_STORE", raising=False)
    return Shell(bench, recipe, capsys)


@pytest.mark.parametrize("group", [[], ["models"]])
def test_a_group_alone_shows_its_help(group: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(group) == 2
    said = capsys.readouterr().err
    assert "error:" not in said and ("Commands:\n" in said or "Make:\n" in said)


def test_run_twice(shell: Shell) -> None:
    code, out, err = shell.run()
    assert code == 0
    assert out.startswith(f"results: {shell.bench.folder}/total\n") and "time: " in out
    assert f"next: cleargs show {shell.bench.folder}\n" in out
    assert "estimate: about" in err and "square: started\n" in err
    code, out, err = shell.run()
    assert code == 0 and "reused: count, square, total\n" in out and err == ""


def again(shell: Shell, *arguments: str) -> tuple[int, str, str]:
    """Call ``cleargs run`` on the same folder without settings."""
    return shell("run", str(shell.bench.capture), "-o", str(shell.bench.folder), *arguments)


def test_an_existing_run_keeps_its_settings_and_says_so(shell: Shell) -> None:
    shell.run("--set", "square.power=3", "--seed", "5")
    shell.bench.work_done()
    code, _, err = again(shell)
    assert code == 0 and shell.bench.work_done() == []
    assert "square.power=3" in err and "seed=5" in err and "--reset" in err
    again(shell, "--set", "count.limit=4")
    assert (shell.bench.folder / "total" / "total.txt").read_text() == "plain 36.0 5", "0 + 1 + 8 + 27"
    assert shell("status", str(shell.bench.folder))[1].count("done") == 3


def test_reset_and_workflow_start_from_the_recipe(shell: Shell) -> None:
    shell.run("--set", "square.power=3")
    shell.run("--set", "total.offset=1")
    total = shell.bench.folder / "total" / "total.txt"
    assert total.read_text() == "plain 56.0 0", "an explicit recipe replaces the settings"
    code, _, err = again(shell, "--reset", "--workflow", shell.recipe)
    assert code == 0 and total.read_text() == "plain 55.0 0" and "--reset" not in err


def test_run_lists_the_stages_that_run_again(shell: Shell) -> None:
    assert "runs again" not in shell.run()[2]
    _, _, err = again(shell, "--set", "square.power=3")
    lines = err.splitlines()
    assert lines[0] == "square runs again: setting square.power: 2 -> 3"
    assert lines[1] == "then: total"
    assert lines[2].startswith("estimate: about") and lines[3].startswith("square: started")


def test_the_cost_is_revised_when_the_capture_is_known(shell: Shell) -> None:
    _, _, err = shell.run("--set", "count.limit=3")
    first, revised, *_ = (line for line in err.splitlines() if "estimate: about" in line)
    assert first == (
        "estimate: about 6.4 min, 0.1 GB memory, 3 MB disk (count 6 s, square 6.0 min, total 18 s)"
    )
    assert revised.startswith("new estimate: about 3.3 min, ")
    assert err.index(revised) > err.index("count: started")


def test_a_place_that_is_no_disk_is_named(shell: Shell) -> None:
    code, _, err = shell("run", str(shell.bench.capture), "-o", "/proc/x", "--workflow", shell.recipe)
    assert code == 1 and "error: cannot write /proc/x" in err and "GB free" not in err


def test_an_existing_run_keeps_its_store(shell: Shell, tmp_path: Path) -> None:
    shell.run("--store", str(tmp_path / "shared"))
    shell.bench.work_done()
    assert again(shell)[0] == 0 and shell.bench.work_done() == []
    assert not shell.bench.store.exists()


def test_settings_that_cannot_be_kept(shell: Shell) -> None:
    shell.run()
    (shell.bench.folder / "run.toml").write_text("[half")
    code, _, err = again(shell)
    assert code == 2 and "--reset" in err.splitlines()[-1]


def test_settings_that_this_version_does_not_have_are_named(shell: Shell) -> None:
    shell.run()
    file = shell.bench.folder / "run.toml"
    file.write_text(file.read_text() + "\n[squarish]\npower = 3\n")
    code, _, err = again(shell, "-q")
    assert code == 0 and err.startswith("warning: ") and "squarish" in err


def test_settings_lists_what_the_models_say(shell: Shell) -> None:
    found = json.loads(shell("settings", "count", "--json")[1])
    assert found[0] == {
        "name": "count.limit",
        "default": 100,
        "allowed": "a whole number, at least 1 and at most 1000",
        "meaning": "maximum count of numbers",
    }
    assert [setting["name"] for setting in found][-1] == "count.inner.depth"
    code, out, _ = shell("settings")
    assert code == 0 and "maximum count of numbers" in out and "power" in out and "offset" in out
    assert shell("settings", "cuont")[2].endswith("hint: did you mean count?\n")


def test_run_json_is_json_and_nothing_else(shell: Shell) -> None:
    code, out, _ = shell.run("--json")
    stages = json.loads(out)
    assert code == 0 and [stage["status"] for stage in stages] == ["complete"] * 3


def test_quiet_says_nothing_on_stderr(shell: Shell) -> None:
    assert shell.run("-q")[2] == ""


def test_dry_run_writes_nothing(shell: Shell) -> None:
    code, out, _ = shell.run("--dry-run")
    assert code == 0 and "waits for count" in out and "estimate: about" in out
    first = out.splitlines()[0]
    assert first.split(maxsplit=2) == ["count", "missing", first[22:]], "one line per stage, with its cost"
    assert re.fullmatch(r"[\d.]+ (s|min), [\d.]+ GB memory, [\d.]+ MB disk +no results yet", first[22:])
    assert not shell.bench.folder.exists()


def test_status_and_stage(shell: Shell) -> None:
    shell.run()
    folder = str(shell.bench.folder)
    assert shell("status", folder)[1].count("done") == 3
    (shell.bench.capture / "1.txt").write_text("50")
    code, out, _ = shell("status", folder)
    assert code == 0 and "external capture: 1.txt changed" in out
    assert [one["state"] for one in json.loads(shell("status", folder, "--json")[1])] == ["outdated"] * 3
    assert shell("explain", folder) == shell("status", folder), "the old name"
    assert "explain" not in shell("--help")[1]
    code, _, err = shell("stage", "total", folder)
    assert code == 1 and "error: total needs count, which is not done" in err
    assert shell("stage", "count", folder)[0] == 0
    assert shell("stage", "square", folder, "--threads", "1")[0] == 0
    states = [one["state"] for one in json.loads(shell("status", folder, "--json")[1])]
    assert states == ["done", "done", "missing"]  # new results drop what was made from the old ones
    assert shell("run", folder)[0] == 0, "a run in place of its capture"
    assert shell("status", folder)[1].count("done") == 3


def test_partial_is_exit_code_3_and_says_what_is_missing(shell: Shell) -> None:
    (shell.bench.capture / "1.txt").write_text("")
    code, out, err = shell.run()
    assert code == 3 and "in part" in out and "missing: count: 1.txt is empty" in err
    code, out, err = shell.run("--allow-partial")
    assert code == 3 and (shell.bench.folder / "total" / "total.txt").exists()
    (shell.bench.capture / "1.txt").write_text("1")
    assert shell.run()[0] == 0


def test_show(shell: Shell) -> None:
    shell.run()
    folder = str(shell.bench.folder)
    code, out, _ = shell("show", folder)
    assert code == 0 and "complete" in out and "total 55" in out
    assert json.loads(shell("show", folder, "square", "--json")[1])["summary"] == {"total": 55}
    code, out, _ = shell("show", folder, "time")
    assert code == 0 and out.split()[:2] == ["part", "seconds"]
    assert set(json.loads(shell("show", folder, "time", "--json")[1])) >= {"square"}


def test_show_and_status_after_a_change(shell: Shell) -> None:
    shell.run()
    again(shell, "--set", "square.power=3", "--until", "count")
    folder = str(shell.bench.folder)
    rows = [line.split()[:2] for line in shell("show", folder)[1].splitlines()[1:4]]
    assert rows == [["count", "complete"], ["square", "not"], ["total", "not"]]
    square = shell("status", folder)[1].splitlines()[1]
    assert square.startswith("square       missing ") and square.endswith("setting square.power: 2 -> 3")
    assert f"not done: see cleargs status {folder}" in shell("show", folder)[1]
    assert json.loads(shell("show", folder, "--json")[1])["square"] is None
    code, _, err = shell("show", folder, "square")
    assert code == 2 and f"see cleargs status {folder}" in err


def test_gc(shell: Shell) -> None:
    shell.run("--set", "square.power=3")
    shell.run()
    folder = str(shell.bench.folder)
    garbage = json.loads(shell("gc", folder, "--dry-run", "--json")[1])
    assert len(garbage) == 2 and all(Path(item["folder"]).exists() for item in garbage)
    shell("gc", folder, "--yes")
    assert not any(Path(item["folder"]).exists() for item in garbage)
    assert "reused: count, square, total" in shell.run()[1]


def test_store_from_the_environment(shell: Shell, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CLEARGS_STORE", str(tmp_path / "shared"))
    assert shell.run()[0] == 0
    assert (tmp_path / "shared" / "count").is_dir() and not shell.bench.store.exists()
    monkeypatch.delenv("CLEARGS_STORE")
    assert shell("status", str(shell.bench.folder))[1].count("done") == 3, "run.toml names the store"


@pytest.mark.parametrize(
    ("arguments", "code", "cause", "hint"),
    [
        (["frob"], 2, "there is no command 'frob'", "cleargs --help"),
        (["run"], 2, "Missing argument 'INPUT'", "cleargs run --help"),
        (["run", "nowhere", "-o", "r"], 2, "nowhere does not exist", "give a video"),
        (
            ["run", ".", "-o", "r", "--workflow", "fast"],
            2,
            "there is no recipe 'fast'",
            "choose one of default",
        ),
        (["run", ".", "-o", "r", "--threads", "0"], 2, "Invalid value for '--threads'", "cleargs run --help"),
        (["status", "nowhere"], 2, "is not a run", "cleargs run INPUT"),
        (["show", "nowhere"], 2, "is not a run", "cleargs run INPUT"),
        (["show", "nowhere", "--columns"], 2, "name of a stage", "show nowhere rva --columns"),
        (["gc"], 2, "no run and no store", "--store"),
        (["stage", "count", "nowhere"], 2, "is not a run", "cleargs run INPUT"),
        (
            ["run", ".", "--until", "nope"],
            2,
            "there is no stage 'nope'",
            "choose one of count, square, total",
        ),
    ],
)
def test_wrong_usage(shell: Shell, arguments: list[str], code: int, cause: str, hint: str) -> None:
    found, out, err = shell(*arguments)
    lines = err.splitlines()
    assert found == code and out == "" and len(lines) == 2
    assert lines[0].startswith("error: ") and cause in lines[0]
    assert lines[1].startswith("hint: ") and hint in lines[1]


def test_damaged_run_file_is_replaced(shell: Shell) -> None:
    shell.run()
    (shell.bench.folder / "run.toml").write_text("[half")
    assert shell("status", str(shell.bench.folder))[0] == 2
    code, out, _ = shell.run()
    assert code == 0 and "reused: count, square, total" in out
    assert shell("status", str(shell.bench.folder))[0] == 0


def test_bad_setting_creates_nothing(shell: Shell) -> None:
    code, _, err = shell.run("--set", "square.power=30")
    assert code == 2 and "at most 4" in err and not shell.bench.folder.exists()


def test_unexpected_error_is_two_lines_without_debug(shell: Shell) -> None:
    (shell.bench.capture / "1.txt").write_text("one")
    code, _, err = shell.run("-q")
    assert code == 1 and "Traceback" not in err and len(err.splitlines()) == 2
    assert "unexpected ValueError" in err and "--debug" in err
    code, _, err = shell.run("-q", "--debug")
    assert code == 1 and "Traceback" in err


def test_machine_errors_have_a_remedy() -> None:
    assert explanation(MemoryError())[1] == "out of memory"
    assert explanation(OSError(28, "No space left on device"))[2].startswith("free some space")
    assert explanation(PermissionError(13, "Permission denied", "/x"))[1] == "Permission denied: /x"


def test_help_of_every_command_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    for name in COMMANDS:
        assert invoke([name, "--help"]) == 0
        assert f"Usage: cleargs {name}" in capsys.readouterr().out


def test_commands_that_write_can_be_quiet() -> None:
    writers = {"run", "batch", "demo", "report", "render", "export", "pack", "eval", "synth", "stage"}
    context = click.Context(cli)
    commands = {name: cli.get_command(context, name) for name in COMMANDS}
    options = {
        name: {option for one in found.params for option in one.opts} for name, found in commands.items()
    }
    assert {name for name, found in options.items() if {"-q", "--progress", "--log"} <= found} == writers


def test_help_and_no_op_import_nothing_heavy(shell: Shell) -> None:
    shell.run()
    heavy = {"torch", "numba", "pycolmap", "cv2", "onnxruntime", "scipy", "pyarrow", "rich"}
    program = (
        "import sys; from pathlib import Path; from cleargs.cli.main import invoke; from toy import toy_dag\n"
        "code = invoke(sys.argv[1:], toy_dag(Path('journal')))\n"
        f"print(code, sorted({heavy!r} & set(sys.modules)))"
    )
    capture, folder = str(shell.bench.capture), str(shell.bench.folder)
    for arguments in (["--help"], ["run", capture, "-o", folder, "--workflow", shell.recipe]):
        done = subprocess.run(
            [sys.executable, "-c", program, *arguments],
            capture_output=True,
            text=True,
            env={"PYTHONPATH": str(Path(__file__).parents[1] / "pipeline")},
        )
        assert done.stdout.splitlines()[-1] == "0 []", done.stderr


def test_installed_stages_load_light() -> None:
    """Planning loads every stage module; a run with nothing to do must not pay for what `run` needs."""
    heavy = {"torch", "numba", "pycolmap", "cv2", "onnxruntime", "scipy"}
    program = (
        "import sys; from cleargs.pipeline.stages import installed\n"
        "from cleargs.pipeline.config import load_config\n"
        f"load_config(installed()); print(sorted({heavy!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


def test_interrupt_ends_a_long_call_of_compiled_code() -> None:
    """Python cannot raise KeyboardInterrupt during the call below, which would take hours."""
    program = (
        "import hashlib; from cleargs.cli.terminal import handle_signals; handle_signals()\n"
        "print('ready', flush=True); hashlib.pbkdf2_hmac('sha256', b'x', b'y', 2**31 - 1)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(1)  # until it is in the call
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and "same command again to resume" in errors
    assert len(errors.splitlines()) == 1


def test_ending_a_forked_child_does_not_end_its_parent() -> None:
    program = (
        "import os, signal, time; from cleargs.cli import terminal\n"
        "terminal.SAVING_S = 1.0\n"
        "terminal.handle_signals()\n"
        "child = os.fork()\n"
        "if child == 0: time.sleep(60); os._exit(0)\n"
        "time.sleep(0.2); os.kill(child, signal.SIGTERM); os.waitpid(child, 0)\n"
        "time.sleep(1.5); print('alive')"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", program], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == "alive\n", done.stderr


def test_a_signal_blocked_at_the_start_stays_blocked() -> None:
    """A parent process that blocks a signal for its child handles the signal itself."""
    program = (
        "import os, signal; from cleargs.cli.terminal import handle_signals\n"
        "signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM}); handle_signals()\n"
        "os.kill(os.getpid(), signal.SIGTERM); print('alive')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == "alive\n", done.stderr


def test_the_end_of_a_run_is_five_lines(tmp_path: Path) -> None:
    def outcome(
        stage: str, how: Literal["found", "made"], files: list[str], **summary: object
    ) -> StageOutcome:
        parts = KeyParts(
            stage=stage, version=1, config={}, inputs={}, externals={}, seed=0, device="cpu", libraries={}
        )
        manifest = Manifest(
            stage=stage,
            key="",
            status="complete",
            missing=(),
            inherited=(),
            parts=parts,
            origins={},
            files={name: FileRecord(size=1, digest="") for name in files},
            digest="",
            versions={},
            started="",
            seconds=90.0,
            device="cpu",
            summary=summary,
        )
        return StageOutcome(stage, how, manifest, tmp_path)

    control = {"frames": [3, 9], "psnr_before": 22.58, "psnr_after": 23.61, "harm": None}
    outcomes = [
        outcome("ingest", "found", [], frames=24, registered=22, test=0),
        outcome("rva", "found", [], roles={"strong": 7}),
        outcome("g0", "made", ["scene.ply"], psnr_unseen=22.58, views=22),
        outcome("rivr", "made", ["scene.ply", "selection.parquet"], control=control, psnr_unseen=23.4),
        outcome(
            "consolidate",
            "made",
            ["scene.ply", "repairs.parquet"],
            repairs=11,
            control=control,
            psnr_unseen=23.61,
        ),
    ]
    run = tmp_path / "my room"
    assert outcome_lines(outcomes, run, run / "report.html") == [
        f"scene: {run}/scene.ply (22 of 24 frames placed, 7 reliable, 11 repaired)",
        "quality: PSNR 23.6 dB (first scene 22.6) on pixels that no training saw; "
        "views off the camera path are worse",
        "time: 4.5 min (g0 90.0 s, rivr 90.0 s, consolidate 90.0 s); reused: ingest, rva",
        f"next: cleargs export '{run}' -o 'my room.sog'",
        f"report: file://{tmp_path}/my%20room/report.html",
    ]
    figure = {"share": 0.65, "median_px": 0.9}
    found = outcome("ingest", "made", [], frames=24, registered=22, kept_out=figure)
    assert "22 of 24 frames placed: 65%" in outcome_lines([found], run)[0]
    found = replace(found, manifest=found.manifest.model_copy(update={"missing": ("cameras",)}))
    assert "22 of 24 frames with doubtful cameras: 65%" in outcome_lines([found], run)[0]
    of_stage = outcome_lines(outcomes[-1:], run)  # as `cleargs stage` does
    assert len(of_stage) == 4 and of_stage[1].startswith("quality: PSNR 23.6 dB on pixels")


def test_the_time_left_counts_from_the_first_step_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first step may wait for the compilation of kernels, so its time does not count."""
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    with make_reporter().task("G0", 1000) as task:
        for now, done in ((100.0, 1), (101.0, 6), (120.0, 101)):
            clock[0] = now
            task.update(done=done)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["G0: 1/1000, for 100 s", "G0: 101/1000, 180 s left", "G0: done in 120.0 s"]


def test_the_time_left_follows_the_work_where_steps_differ(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of the steps may be a quarter of the work: the last steps have the most Gaussians."""
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    with make_reporter().task("G0", 1000) as task:
        for now, done, share in ((100.0, 1, 0.0), (110.0, 500, 0.25)):
            clock[0] = now
            task.update(done=done, share=share)
    assert "G0: 500/1000, 30 s left" in capsys.readouterr().err.splitlines()


FACTS = {"gpu": "NVIDIA A1", "driver": "550.54.15"}
PASSED = SelfTest(FACTS, [Check("Adam", [], 1.0)], gpu_ms=2.0, cpu_ms=60.0)
FAILED = SelfTest(FACTS, [Check("Adam", ["means: differs by 1"], 1.0)])


def test_auto_uses_a_tested_gpu_and_dry_run_tests_none(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    results = [None, PASSED]
    asked = Machine(lambda: None, lambda: FACTS, lambda facts: results[0], lambda facts, say: results.pop())
    monkeypatch.setattr(session, "Machine", lambda: asked)
    assert "device: the CPU, because the GPU is not tested yet" in shell.run("--dry-run")[2]
    assert "device: the GPU, because NVIDIA A1 passed its self-test" in shell.run()[2]
    assert 'device = "cuda"' in (shell.bench.folder / "run.toml").read_text()
    assert "device: the" not in shell.run("--device", "cpu")[2]


@pytest.mark.parametrize(
    ("obstacle", "tested", "state", "words"),
    [
        ("there is no NVIDIA GPU", None, "ok", "cpu (there is no NVIDIA GPU)"),
        (None, None, "note", "cpu (the GPU is not tested yet: cleargs doctor --gpu)"),
        (None, PASSED, "ok", "cuda (NVIDIA A1 passed its self-test; a training step takes 2 ms"),
        (None, FAILED, "note", "cpu (the GPU failed its self-test (Adam: means: differs by 1)"),
    ],
)
def test_the_doctor_names_the_device(
    obstacle: str | None, tested: SelfTest | None, state: str, words: str
) -> None:
    found, report = device_of(Machine(lambda: obstacle, lambda: FACTS, lambda facts: tested), False)
    assert (found.what, found.state, report) == ("device", state, [])
    assert found.text.startswith(words)


def test_the_doctor_tests_the_gpu(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def use(machine: Machine) -> None:
        monkeypatch.setattr(doctor, "Machine", lambda: machine)

    use(Machine(lambda: "there is no NVIDIA GPU"))
    assert invoke(["doctor", "--gpu"]) == 1
    assert "bad   device" in capsys.readouterr().out
    for tested, last in (
        (PASSED, ["Adam: passed, 1.0 s", "a training step takes 2 ms on the GPU, 60 ms on the CPU"]),
        (FAILED, ["Adam: failed, 1.0 s", "  means: differs by 1"]),
    ):
        use(Machine(lambda: None, lambda: FACTS, self_test=lambda facts, say, tested=tested: tested))
        code, lines = invoke(["doctor", "--gpu"]), capsys.readouterr().out.splitlines()
        assert lines[-2:] == last
        assert "driver: 550.54.15" in lines
        assert f"{'bad' if tested is FAILED else 'ok':<5} device" in "\n".join(lines)
        assert code == (1 if tested is FAILED else 0)


def test_windows_is_refused_and_macos_is_not() -> None:
    script = (
        "import sys, pydantic, cleargs.cli.main; from cleargs.cli.entry import main\n"
        "sys.platform = {!r}; sys.argv[1:] = ['-V']; main()"
    )
    windows, macos = (
        subprocess.run([sys.executable, "-c", script.format(name)], capture_output=True, text=True)
        for name in ("win32", "darwin")
    )
    cause, remedy = windows.stderr.splitlines()
    assert windows.returncode == 2 and "Windows" in cause and "WSL 2" in remedy
    assert macos.returncode == 0 and "version" in macos.stdout, macos.stderr


@pytest.mark.parametrize(("own", "policy"), [({}, "passive"), ({"OMP_WAIT_POLICY": "active"}, "active")])
def test_threads_wait_passively_by_default(own: dict[str, str], policy: str) -> None:
    script = (
        "import os, sys\nfrom cleargs.cli.entry import main\nsys.argv = ['cleargs', '--version']\n"
        "try:\n    main()\nfinally:\n    print(os.environ['OMP_WAIT_POLICY'])"
    )
    outside = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env={**outside, **own}, check=True
    )
    assert done.stdout.splitlines()[-1] == policy


def test_cores_are_counted_without_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert usable_cores() == 6
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert usable_cores() == 1


def test_a_run_is_not_a_capture(shell: Shell) -> None:
    shell.run()
    code, _, err = shell("run", str(shell.bench.folder), "-o", str(shell.bench.root / "other"))
    assert code == 2 and "is a run, not a capture" in err and str(shell.bench.capture) in err


def test_gc_refuses_a_folder_that_is_not_a_store(shell: Shell, tmp_path: Path) -> None:
    """Otherwise `gc` would follow the links of a run, and treat any folder `work` as unfinished work."""
    shell.run()
    thesis = tmp_path / "papers" / "work" / "thesis.tex"
    thesis.parent.mkdir(parents=True)
    thesis.write_text("years")
    for folder in (shell.bench.folder, tmp_path / "papers"):
        code, _, errors = shell("gc", "--store", str(folder), "--checkpoints")
        assert code == 2 and "is not a store" in errors
    assert thesis.is_file()
    assert "reused: count, square, total" in shell.run()[1]


@pytest.mark.parametrize(
    ("made", "source", "folder"),
    [
        ("walk.mp4", "walk.mp4", "walk"),
        ("walk.mp4 walk/", "walk.mp4", "walk-scene"),
        ("walk.mp4 walk/run.toml", "walk.mp4", "walk"),
        ("walk/", "walk", "walk-scene"),
        ("walk", "walk", "walk-scene"),
        ("walk.images/", "walk.images/", "walk.images-scene"),
        ("place/walk/", "place/walk/../walk/.", "place/walk-scene"),
    ],
)
def test_the_run_folder_is_next_to_the_input(
    made: str, source: str, folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in made.split():
        path = Path(name)
        (path if name.endswith("/") else path.parent).mkdir(parents=True, exist_ok=True)
        if not name.endswith("/"):
            path.touch()
    assert default_folder(Path(source)).resolve() == tmp_path / folder
    if Path(source).is_dir():
        monkeypatch.chdir(source)
        assert default_folder(Path()).resolve() == tmp_path / folder


def test_a_run_by_the_name_of_its_input_alone(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    before = sorted(shell.bench.capture.iterdir())
    code, out, _ = shell("run", str(shell.bench.capture), "--recipe", shell.recipe)
    folder = shell.bench.capture.with_name(f"{shell.bench.capture.name}-scene")
    assert code == 0 and out.startswith(f"results: {folder}/total")
    assert shell("run", str(shell.bench.capture), "-o", str(shell.bench.capture))[0] == 2
    assert sorted(shell.bench.capture.iterdir()) == before, "nothing is written into the input"


def test_the_run_folder_has_a_log_and_a_link_to_the_scene(shell: Shell) -> None:
    shell.run("--log", str(shell.bench.root / "mine.log"), "-q")
    log = (shell.bench.folder / "run.log").read_text()
    assert "square: started" in log and "results: " in log, "whatever is printed"
    assert "square: started" in (shell.bench.root / "mine.log").read_text()
    (shell.bench.capture / "1.txt").write_text("no number")
    assert again(shell)[0] == 1
    assert "error: unexpected ValueError" in (shell.bench.folder / "run.log").read_text()
    assert "key " in shell.run("-v", "--until", "count")[2]


def test_events_are_json_lines(shell: Shell) -> None:
    events = [json.loads(line) for line in shell.run("--progress", "json")[2].splitlines()]
    assert {event["event"] for event in events} >= {"info", "begin", "end"}
    assert any(event.get("text", "").startswith("square: started") for event in events)


def test_one_setting_twice_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["run", str(tmp_path), "--steps", "30", "--set", "g0.steps=40"]
    assert invoke(given) == 2 and "--steps and --set g0.steps" in capsys.readouterr().err
    assert invoke([*given[:3], "30", *given[4:5]]) == 2  # --set without a value


def test_options_without_effect_are_named() -> None:
    dag = installed()
    given = ["g0.quality=draft", "ingest.max_frames=100"]
    (line,) = without_effect(load_config(dag, overrides=given), given)
    assert line == "ingest.max_frames=100 has no effect: with quality draft it is 60"
    (line,) = without_effect(load_config(dag, "smoke", ["g0.quality=high"]), ["g0.quality=high"])
    assert "g0.steps=400" in line and "g0.budget=30000" in line and "--reset" in line
    assert not list(without_effect(load_config(dag, overrides=["g0.quality=high"]), ["g0.quality=high"]))


@pytest.mark.parametrize(
    ("given", "hint"),
    [
        ("rnu", "did you mean cleargs run?"),
        ("explian", "did you mean cleargs status?"),
        ("walk.mp4", "did you mean cleargs run walk.mp4?"),
        ("no idea", "see cleargs --help"),
    ],
)
def test_a_wrong_command_is_guessed(given: str, hint: str, shell: Shell) -> None:
    code, _, err = shell(given)
    assert code == 2 and err.splitlines()[1] == f"hint: {hint}"


def test_a_path_in_place_of_a_command(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    shell.run()
    monkeypatch.chdir(shell.bench.root)
    shell.bench.folder.rename("room")
    for name, command in ((shell.bench.capture.name, "run"), ("room", "show")):
        assert f"did you mean cleargs {command} {name}?" in shell(name)[2]


def test_other_ways_to_ask_for_help(shell: Shell) -> None:
    assert shell("help", "status") == shell("status", "--help")
    assert shell("help") == shell("--help") and shell("-V") == shell("--version")
    sections = shell("--help")[1].partition("More:")[0]
    listed = [name for name in COMMANDS if f"\n  {name} " in sections]
    assert 12 <= len(listed) <= 15 and {"run", "report", "export"} <= set(listed)


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("cleargs sta", ["status", "stage"]),
        ("cleargs run x --until r", ["rva", "rivr"]),
        ("cleargs run x --recipe pa", ["paper", "paper-open"]),
        ("cleargs run x --set g0.ste", ["g0.steps="]),
        ("cleargs synth x --protocol gs2e-s", ["gs2e-slight", "gs2e-severe", "gs2e-stretches"]),
        ("cleargs show x in", ["ingest"]),
    ],
)
def test_completion(words: str, found: list[str]) -> None:
    asked = {"_CLEARGS_COMPLETE": "zsh_complete", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    done = subprocess.run(
        [sys.executable, "-m", "cleargs"],
        capture_output=True,
        text=True,
        env={**os.environ, **asked, "COMP_WORDS": words.rpartition(" ")[0] + " " + words.rpartition(" ")[2]},
    )
    assert done.stdout.splitlines()[1::3] == found, done.stderr


def test_the_script_of_the_completion(shell: Shell) -> None:
    code, out, _ = shell("completion", "bash")
    assert code == 0 and "_CLEARGS_COMPLETE=bash_complete" in out and "complete -o nosort" in out


def test_printed_commands_run_as_printed(tmp_path: Path) -> None:
    """Once, the demo ended with a bare ``cleargs``, which no shell found."""
    (home := tmp_path / "my env" / "bin").mkdir(parents=True)
    (home / "python").symlink_to(sys.executable)
    (home / "cleargs").write_text("")
    (tmp_path / "other").mkdir()
    code = (
        "from cleargs.cli.commands import as_called; from cleargs.program import name_program\n"
        "name_program(); print(as_called('x cleargs run y'))"
    )
    for path, folder, words in (
        ("/usr/bin", tmp_path, "x 'my env/bin/cleargs' run y"),
        ("/usr/bin", tmp_path / "other", f"x '{home}/cleargs' run y"),
        (f"{home}:/usr/bin", tmp_path, "x cleargs run y"),
    ):
        (home / "cleargs").chmod(0o755)
        run = f"import sys; sys.executable = {str(home / 'python')!r}; {code}"
        outside = {"PATH": path, "HOME": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[2])}
        done = subprocess.run(
            [sys.executable, "-c", run], capture_output=True, text=True, env=outside, cwd=folder
        )
        assert done.stdout.strip() == words, done.stderr


def test_the_users_configuration(shell: Shell, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (tmp_path / "cleargs").mkdir()
    file = tmp_path / "cleargs" / "config.toml"
    file.write_text(f"store = {str(tmp_path / 'shared')!r}\nthreads = 1\n")
    assert shell.run()[0] == 0
    assert (tmp_path / "shared" / "count").is_dir() and not shell.bench.store.exists()
    file.write_text(f"store = {str(tmp_path / 'other')!r}\n")
    code, out, _ = again(shell)
    assert code == 0 and "reused: count" in out, "an existing run keeps its store"
    invoke(["doctor", "--json"])
    assert str(file) in shell.capsys.readouterr().out
    for text, words in (("devcie = 'cpu'", "did you mean device?"), ("threads = 0", "'--threads'")):
        file.write_text(text)
        code, _, err = again(shell)
        assert code == 2 and words in err


def test_diff(shell: Shell) -> None:
    shell.run("--set", "square.power=3")
    other = shell.bench.root / "other"
    shell("run", str(shell.bench.capture), "-o", str(other), "--recipe", shell.recipe)
    found = json.loads(shell("diff", str(shell.bench.folder), str(other), "--json")[1])
    assert found["settings"] == {"square.power": [3, 2]}
    assert found["figures"].keys() >= {"square: time, s", "all stages: time, s"}
    code, out, _ = shell("diff", str(shell.bench.folder), str(other))
    assert code == 0 and "square.power" in out and "all stages: time, s" in out


def test_stretch_of_a_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``--start`` and ``--end`` are settings of ingest."""
    frames = [np.full((64, 96, 3), 8 * index, np.uint8) for index in range(30)]
    write_video(tmp_path / "walk.mp4", frames, 10.0)
    common = ["run", str(tmp_path / "walk.mp4"), "-o", str(tmp_path / "run"), "--until", "ingest"]
    assert invoke([*common, "--start", "2", "--end", "1"]) == 2
    assert "between ingest.start and ingest.end: it lasts 2.9 s" in capsys.readouterr().err
    assert invoke([*common, "--start", "1", "--end", "2.05"]) == 1  # nothing in these frames can be matched
    assert "11 of 11 frames" in capsys.readouterr().err
