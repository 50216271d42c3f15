"""The folder of compiled kernels."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from types import SimpleNamespace
from typing import Any

from cleargs import kernel_cache
from cleargs.kernel_cache import cache_folder, installation
from cleargs.pipeline.stages import installed
from cleargs.progress import COMPILING, LineReporter, SilentReporter
from cleargs.splat import compilation
from cleargs.splat.kernels.cpu.jit import compiled_mark


def test_cache_falls_back_to_a_temporary_folder(monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.touch()  # a file, so that even root cannot create a folder in it
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.setenv(name, str(blocked))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = cache_folder("kernels")
    assert folder.parent == tmp_path
    assert folder.name.startswith("cleargs-kernels-")
    monkeypatch.setattr(compilation.subprocess, "Popen", None)  # it is not called
    compilation.begin()


def test_cache_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "chosen"))
    assert cache_folder("kernels") == tmp_path / "chosen" / "kernels"
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    assert cache_folder("kernels") == tmp_path / "own" / "cleargs" / "kernels"


def test_another_installation_compiles_again(monkeypatch, tmp_path):
    """Numba's cache is one per place and time of the sources. Once, this was a silent minute."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    source = tmp_path / "splat/kernels/cpu/loss.py"
    source.parent.mkdir(parents=True)
    source.touch()
    before = installation()
    said: list[str] = []
    reporter = LineReporter(said.append, said.append, said.append)

    def finish() -> None:
        compilation.finish("cpu", lambda: said.append("compiled"), reporter)

    finish()
    finish()
    assert said[0] == f"{COMPILING}: started" and said[1] == "compiled", "announced before it is silent"
    assert said[2].startswith(f"{COMPILING}: done in") and said[3:] == ["compiled"]
    monkeypatch.setattr(kernel_cache, "__file__", str(tmp_path / "kernel_cache.py"))
    elsewhere = installation()
    os.utime(source, ns=(1, 1))
    assert len({before, elsewhere, installation()}) == 3
    finish()
    assert said[4] == f"{COMPILING}: started"


COMPILES = """
from cleargs.splat import compilation
def warm_up():
    print("begun", flush=True)
    input()
with compilation._compiling("cpu"):
    compilation._compile("cpu", warm_up)
"""


def test_a_training_waits_for_the_child_that_compiles(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    command = [sys.executable, "-c", COMPILES]
    with subprocess.Popen(command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None and child.stdin is not None
        assert child.stdout.readline() == "begun\n"
        said: list[str] = []

        class Lets(LineReporter):
            """Lets the child go on when the task is open."""

            def task(self, label: str, total: int | None = None) -> Any:
                said.append(label)
                assert not compiled_mark("cpu").exists()
                child.communicate("go on\n")
                return super().task(label, total)

        silent = lambda text: None  # noqa: E731
        compilation.finish(
            "cpu", lambda: said.append(str(compiled_mark("cpu").exists())), Lets(*[silent] * 3)
        )
    assert said == [COMPILING, "True"]  # loads what the child has compiled


def test_a_run_compiles_next_to_its_first_stage(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    started: list[list[str]] = []

    def start(command: list[str], **_: object) -> SimpleNamespace:
        started.append(command)
        return SimpleNamespace(poll=lambda: None)  # it works until the end of the test

    monkeypatch.setattr(compilation.subprocess, "Popen", start)
    monkeypatch.setattr(compilation, "_children", [])
    prepare = installed().prepare
    prepare(["ingest", "rva"])
    assert not started, "no training follows"
    prepare(["ingest", "rva", "g0"])
    prepare(["g0"])
    assert [command[-1] for command in started] == ["cleargs.splat.compilation"]
    monkeypatch.setattr(compilation, "_children", [])
    compilation.finish("cpu", lambda: None, SilentReporter())
    prepare(["g0"])
    assert len(started) == 1, "the kernels are compiled"
