"""Names from files cannot steer the terminal, and no error of the system is unexpected."""

from __future__ import annotations

import errno
import io
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from toy import Bench

from cleargs.cli.main import explanation, invoke
from cleargs.cli.progress_bars import make_reporter
from cleargs.cli.terminal import EscapingStream
from cleargs.cli.terminal_table import print_table
from cleargs.errors import InputError
from cleargs.safe_io import printable

CLIPBOARD = "\x1b]52;c;ZXZpbA==\x07"
CLEAR = "\x1b[2J\x1b[H"
FORGED = "x\nerror: everything is lost"
REVERSED = "gpj.\u202eexe"


@pytest.mark.parametrize(
    "name", [CLIPBOARD, CLEAR, "\x9b2J", FORGED, REVERSED, "caf\udce9", "\x7f", "\u2028"]
)
def test_harmful_characters_are_shown(name: str) -> None:
    shown = printable(name)
    assert "\n" not in shown and shown.isprintable() and shown.encode()
    assert json.loads(f'"{shown}"') == name, "the escapes are those of JSON"


@pytest.mark.parametrize("name", ["Zimmer 3/größe.png", "写真.jpg", "e\u0301 🙂", "مرحبا"])
def test_other_languages_stay(name: str) -> None:
    assert printable(name) == name


def printed(text: str, encoding: str = "utf-8") -> str:
    buffer = io.BytesIO()
    plain = io.TextIOWrapper(buffer, encoding=encoding, write_through=True)
    stream = EscapingStream(plain)
    stream.write(text)
    return buffer.getvalue().decode(encoding)


def test_the_streams_escape_all_but_lines_and_colours() -> None:
    assert printed(f"a\tb\n{CLEAR}\n") == "a\tb\n\\u001b[2J\\u001b[H\n"
    assert printed("\x1b[1;31mred\x1b[0m\n") == "\x1b[1;31mred\x1b[0m\n"
    assert printed("3 ● größe\n", "ascii") == "3 \\u25cf gr\\xf6\\xdfe\n"


def test_errors_and_reports_are_one_line_each(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    _, cause, remedy = explanation(InputError(f"no {CLIPBOARD}{FORGED}", hint=FORGED))
    assert cause.isprintable() and remedy.isprintable()
    reporter = make_reporter()
    reporter.warn(FORGED)
    reporter.info(CLEAR)
    with reporter.task(CLIPBOARD, 1) as task:
        task.update(note=FORGED)
    told = capsys.readouterr().err
    assert len(told.splitlines()) == 3 and "\x1b" not in told and "\x07" not in told
    (bench.capture / "2.txt").write_text("")
    (bench.capture / "2.txt").rename(bench.capture / f"2{CLEAR}\nerror: x.txt")
    invoke(["run", str(bench.capture), "-o", str(bench.folder), "--workflow", str(empty(bench))], bench.dag)
    told = capsys.readouterr().err
    assert "\x1b" not in told and "\nerror" not in told and "is empty" in told


def empty(bench: Bench) -> Path:
    recipe = bench.root / "empty.toml"
    recipe.touch()
    return recipe


def behind(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


UNLOADABLE = ImportError("libx.so: failed to map segment from shared object")


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (MemoryError(), 1, "out of memory"),
        (behind(RuntimeError("Cannot import the C++ backend"), UNLOADABLE), 1, "out of memory"),
        (RuntimeError("can't start new thread"), 1, "out of memory"),
        (UNLOADABLE, 1, "out of memory"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "x" * 300), 2, "too long"),
    ],
)
def test_errors_of_the_system_are_explained(error: Exception, code: int, words: str) -> None:
    found, cause, _ = explanation(error)
    assert found == code and words in cause and "unexpected" not in cause


def test_out_of_memory_names_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (2_600_000_000, -1))
    code, cause, remedy = explanation(MemoryError())
    assert (code, cause) == (1, "out of memory")
    assert "limit on virtual memory, 2.6 GB: ulimit -v unlimited" in remedy


@pytest.mark.parametrize(
    ("variable", "value", "imports"),
    [
        ("NUMBA_NUM_THREADS", "0", "numba"),
        ("NUMBA_NUM_THREADS", "-2", "numba"),
        ("SOURCE_DATE_EPOCH", "x", "numpy.f2py"),
    ],
)
def test_a_variable_that_a_library_refuses_is_named(variable: str, value: str, imports: str) -> None:
    code = f"from cleargs.cli.main import explanation\ntry:\n    import {imports}\n"
    code += "except Exception as error:\n    print(*explanation(error), sep='; ')"
    environment = {**os.environ, variable: value}
    told = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert told.stdout.startswith(f"2; the environment variable {variable}={value} cannot be used: ")
    assert explanation(ValueError("no library"))[1] == "unexpected ValueError: no library"


def test_a_path_that_is_too_long(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["run", str(bench.capture), "-o", str(bench.root / ("x" * 300)), "--workflow"]
    assert invoke([*arguments, str(empty(bench))], bench.dag) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: File name too long") and "choose another path" in told


def test_a_name_that_is_not_utf8(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    for place in (bench.capture / os.fsdecode(b"caf\xe9.txt"), bench.root / os.fsdecode(b"caf\xe9")):
        arguments = ["run", str(bench.capture), "-o", str(bench.folder), "--workflow", str(empty(bench))]
        if place.parent == bench.capture:
            place.write_text("7")
        else:
            arguments[3] = str(place)
        assert invoke(arguments, bench.dag) == 2
        told = capsys.readouterr().err
        assert "caf\\udce9" in told and "is not UTF-8" in told and "rename it" in told
        place.unlink(missing_ok=True)
        assert not bench.folder.exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["eval", "RUN", "--reference", "{}"],
        ["run", "CAP", "-o", "R", "--set", "rivr.expert={}"],
        ["synth", "{}"],
    ],
)
def test_arguments_that_are_not_utf8_are_refused(
    arguments: list[str], bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    """Once they caused "unexpected" errors, one of them after all the work."""
    given = [argument.format(os.fsdecode(b"caf\xe9")) for argument in arguments]
    assert invoke(given, bench.dag) == 2
    told = capsys.readouterr().err
    assert "caf\\udce9" in told and "is not UTF-8" in told and "rename it" in told


def test_an_early_interrupt_is_silent() -> None:
    """The signal arrives while the program imports the commands."""
    program = (
        "import os, signal, sys, time, types\n"
        "class Slow(types.ModuleType):\n"
        "    def __getattr__(self, name):\n"
        "        os.kill(os.getpid(), signal.SIGINT); time.sleep(60)\n"
        "sys.modules['cleargs.cli.main'] = Slow('slow')\n"
        "from cleargs.cli.entry import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == -2 and done.stderr == ""


def test_an_interrupt_during_the_setup_of_signals() -> None:
    """Once, a signal during the start of the waiting thread caused a traceback."""
    program = (
        "import os, signal, threading\n"
        "start = threading.Thread.start\n"
        "def interrupted(thread):\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    start(thread)\n"
        "threading.Thread.start = interrupted\n"
        "from cleargs.cli.main import main; main(['--help'])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 130 and done.stdout == ""
    assert done.stderr.startswith("interrupted") and done.stderr.count("\n") == 1


def test_the_installed_script_escapes(bench: Bench) -> None:
    """Names are escaped on a pipe too, in a real process."""
    program = "import sys; from cleargs.cli.main import main; main(sys.argv[1:])"
    done = subprocess.run(
        [sys.executable, "-c", program, "show", str(bench.root / f"no{CLEAR}\nerror: run")],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )
    assert done.returncode == 2 and "\x1b" not in done.stderr and "\nerror: run" not in done.stderr


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_show_wraps_labels_and_cuts_no_value(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    label = "median error of matches that the fit did not use, by origin of the poses, px"
    print_table([(label, "0.251 given, 0.183 adjusted"), ("focal length, px", "1234.567")], title="ingest")
    out = capsys.readouterr().out
    assert "0.251 given," in out and "1234.567" in out and "…" not in out
    assert (
        " ".join(line[: out.splitlines()[1].index("0.251")].strip() for line in out.splitlines()[1:-1])
        == label
    )
    print_table(
        [
            ["ingest", "complete", "1234.5", "12345.6", "frames 150, frames with a pose 149"],
            ["rva", "not done"],
        ],
        *("stage", "state", "seconds", "MB", "figures"),
        wraps="figures",
    )
    out = capsys.readouterr().out
    assert all(word in out for word in ("complete", "1234.5", "12345.6", "frames", "150,", "pose"))
    print_table([["  triangulating", "0.6", "#" * 20]], "part of the time", "seconds", "")
    out = capsys.readouterr().out
    assert "  triangulating" in out and "#" * 20 in out, out
    assert all(line == line.rstrip() for line in out.splitlines()), out
