"""The child process: it may abort, it can be killed, and it does not outlive its parent."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from cleargs.capture import child
from cleargs.capture.child import run_child
from cleargs.errors import StageError, StoreError
from cleargs.progress import SilentReporter, Task
from cleargs.timing import recorded, timed

PREAMBLE = """
import os, sys, time
from pathlib import Path
from cleargs.capture.child import reports_to_parent
report = reports_to_parent()
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module of that name for the child, to be filled by the test."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path / "child_under_test.py"


def run(module: Path) -> None:
    run_child(module.stem, module.with_suffix(".json"), module.with_suffix(".log"), SilentReporter())


def test_a_failed_check_becomes_an_error(module: Path) -> None:
    module.write_text(PREAMBLE + "import pycolmap\npycolmap.logging.fatal('the sky fell')\n")
    with pytest.raises(StageError, match=r"Aborted.*the sky fell") as caught:
        run(module)
    assert "\n" not in str(caught.value)


def test_a_traceback_becomes_an_error(module: Path) -> None:
    module.write_text(PREAMBLE + "raise ValueError('no such thing')\n")
    with pytest.raises(StageError, match=r"exit 1.*no such thing"):
        run(module)


def test_a_named_error_arrives(module: Path) -> None:
    module.write_text(PREAMBLE + "report(phase='x', total=2)\nreport(error='why', hint='what')\nsys.exit(3)")
    with pytest.raises(StageError, match="why") as caught:
        run(module)
    assert caught.value.hint == "what"


def test_processor_time_counts_for_the_phase_that_used_it(module: Path) -> None:
    """Not for the work around the child, which waits for its end."""

    class Timed(SilentReporter):
        @contextmanager
        def task(self, label: str, total: int | None = None) -> Iterator[Task]:
            with timed(label), super().task(label, total) as task:
                yield task

    busy = "begun = time.process_time()\nwhile time.process_time() - begun < 0.5: pass\n"
    module.write_text(
        PREAMBLE
        + f"report(phase='busy', total=None)\n{busy}"
        + "report(phase='idle', total=None)\ntime.sleep(0.1)\n"
        + f"report(phase='last', total=None)\n{busy}"
    )
    with recorded() as times:
        run_child(module.stem, module.with_suffix(".json"), module.with_suffix(".log"), Timed())
    rows = {row.part[0]: row.cpu_seconds for row in times.rows()}
    assert rows["busy"] >= 0.5 > rows["idle"] and rows["last"] >= 0.5


def test_prints_do_not_disturb_the_reports(module: Path) -> None:
    module.write_text(
        PREAMBLE + "print('hello')\nreport(phase='x', total=2)\nos.system('echo hi')\nreport(done=2)"
    )
    run(module)
    assert "hello" in module.with_suffix(".log").read_text()


def gone(pid: int) -> bool:
    """Return True if the process ends within a minute (a zombie that nobody waits for counts as ended)."""
    for _ in range(1200):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_the_child_ends_with_its_parent(module: Path, how: signal.Signals) -> None:
    # Busy in COLMAP, not in Python: what must be interruptible is C++.
    module.write_text(
        PREAMBLE
        + """
import pycolmap
Path(sys.argv[1]).write_text(str(os.getpid()))
options = pycolmap.SyntheticDatasetOptions()
options.num_frames_per_rig, options.num_points3D = 200, 20000
while True:
    pycolmap.synthesize_dataset(options)
"""
    )
    note = module.with_suffix(".json")
    parent = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import signal, sys; from pathlib import Path; from cleargs.capture.child import run_child; "
            "from cleargs.progress import SilentReporter; "
            # Tests in the background of a shell inherit that it is ignored.
            "signal.signal(signal.SIGINT, signal.default_int_handler); "
            f"note = {str(note)!r}; "
            f"run_child({module.stem!r}, Path(note), Path(note + '.log'), SilentReporter())",
        ],
        stderr=subprocess.DEVNULL,
    )
    try:
        for _ in range(400):
            if note.exists() and note.read_text():
                break
            time.sleep(0.05)
        child = int(note.read_text())
        os.kill(parent.pid, how)
        parent.wait(timeout=10)
        assert gone(child)
    finally:
        parent.kill()


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_what_a_killed_child_started_ends_too(module: Path) -> None:
    module.write_text(
        PREAMBLE
        + """
import signal, subprocess
started = subprocess.Popen(["sleep", "600"])
Path(sys.argv[1]).write_text(str(started.pid))
os.kill(os.getpid(), signal.SIGKILL)
"""
    )
    with pytest.raises(StageError, match="Killed"):
        run(module)
    assert gone(int(module.with_suffix(".json").read_text()))


def test_interrupted_when_the_child_has_just_ended(module: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is nobody left to kill: the interrupt must arrive, and no complaint about that."""

    def follow(process: subprocess.Popen[str], reporter: object) -> None:
        process.wait()
        raise KeyboardInterrupt

    monkeypatch.setattr(child, "_follow", follow)
    module.write_text(PREAMBLE)
    with pytest.raises(KeyboardInterrupt):
        run(module)


@pytest.mark.parametrize("importer", ["cameras", "sfm", "sfm_worker"])
def test_importing_colmap_leaves_signals_as_they_are(importer: str) -> None:
    """pycolmap's glog would print a stack trace at SIGTERM and die of it."""
    program = (
        "import os, signal, time\n"
        "def answer(number, frame): raise KeyboardInterrupt\n"
        "signal.signal(signal.SIGTERM, answer)\n"
        f"import cleargs.capture.{importer}\n"
        "try: os.kill(os.getpid(), signal.SIGTERM); time.sleep(5)\n"
        "except KeyboardInterrupt: print('answered')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "answered\n", "")


def test_colmap_as_the_first_import_leaves_other_libraries_working() -> None:
    program = (
        "from cleargs.capture.colmap import pycolmap\n"
        "import io\n"
        "from PIL import Image\n"
        "for kind in ('PNG', 'JPEG', 'TIFF', 'WEBP'): Image.new('RGB', (64, 64)).save(io.BytesIO(), kind)\n"
        "print('saved')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "saved\n")


def test_a_full_disk_is_the_cause(module: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """COLMAP and SQLite fail at whatever they were doing, and speak of that."""
    usage = child.shutil.disk_usage(module.parent)
    monkeypatch.setattr(child.shutil, "disk_usage", lambda path: usage._replace(free=2**20))
    module.write_text(PREAMBLE + "report(error='no features were found', hint='other images')\nsys.exit(3)")
    with pytest.raises(StoreError, match="no space left") as caught:
        run(module)
    assert "free some space" in caught.value.hint


def test_a_disk_that_tells_no_size_is_not_called_full(module: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As FUSE's FAT32 and some network shares."""
    monkeypatch.setattr(child.shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(0, 0, 0))
    module.write_text(PREAMBLE + "raise ValueError('no such thing')\n")
    with pytest.raises(StageError, match="no such thing"):
        run(module)


def test_a_disk_that_holds_no_database_is_named(module: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def connect(file: Path) -> None:
        raise sqlite3.OperationalError("disk I/O error")

    monkeypatch.setattr(child.sqlite3, "connect", connect)
    module.write_text(PREAMBLE + "raise ValueError('no such thing')\n")
    with pytest.raises(StoreError, match="cannot hold the database") as caught:
        run(module)
    assert "--store on another disk" in str(caught.value.hint)
