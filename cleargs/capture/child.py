"""Work in a child process that reports progress, can be killed, and may abort without ending this process.

The child writes JSON objects, one per line, to its standard output. ``{"phase": label, "total": n}`` opens a
phase, ``{"done": k}`` advances it, ``{"error": cause, "hint": remedy}`` reports a failure. Each also has
``cpu``, the processor time so far. The child's standard error (COLMAP's log) goes to a file. It and its own
children end with the parent: the child watches its standard input, whose other end closes when the parent
ends for any reason.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path

from cleargs.errors import StageError, StoreError
from cleargs.files import disk_error
from cleargs.progress import Reporter, Task
from cleargs.subprocesses import module_command
from cleargs.timing import child_used, cpu_seconds

_FULL = 8 * 2**20  # a disk with fewer free bytes counts as full: SQLite writes blocks of up to some MB


def reports_to_parent() -> Callable[..., None]:
    """Reserve standard output for reports. Return a function that sends its keyword arguments as a report.

    The output of libraries goes to the log. From now on, the process group of this process ends when its
    parent ends.
    """
    reports = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    return lambda **message: print(json.dumps({**message, "cpu": cpu_seconds()}), file=reports)


def _die_with_parent() -> None:
    # Not sys.stdin: its lock, held by this thread, would abort the interpreter's shutdown.
    while os.read(0, 1024):
        pass
    os.killpg(0, signal.SIGKILL)


def run_child(module: str, job: Path, log: Path, reporter: Reporter) -> None:
    """Run ``python -P -m module job`` to its end, showing its progress.

    If this call ends early (for example by Ctrl-C), the child and its own children are killed first. Raises
    StageError with the cause that the child reported, or with the last failed check in ``log`` if the child
    aborted, and StoreError if the disk is full.
    """
    # Sums in COLMAP's and numpy's linear algebra must not depend on threads.
    single = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    with (
        log.open("w", encoding="utf-8") as errors,
        subprocess.Popen(
            module_command(module, str(job)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env={**os.environ, **single},
            text=True,
            start_new_session=True,
        ) as child,
    ):
        try:
            failure = _follow(child, reporter)
            status = child.wait()
        finally:
            child_used(0.0)
            with suppress(OSError):  # the processes have ended
                os.killpg(child.pid, signal.SIGKILL)
    # On a full disk, COLMAP and SQLite fail with unrelated messages.
    if status != 0:
        disk = shutil.disk_usage(log.parent)
        if disk.total and disk.free < _FULL:  # some network disks do not tell their size
            raise disk_error(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), log)
    if failure is not None:
        raise failure
    if status != 0:
        _require_databases(log.parent)
        reason = f"exit {status}" if status > 0 else signal.strsignal(-status)
        raise StageError(
            f"COLMAP stopped ({reason}): {_last_failure(log)}",
            hint="try other images, another ingest.camera_model or fewer ingest.max_features",
        )


def _require_databases(folder: Path) -> None:
    """Raise StoreError if SQLite cannot write in ``folder`` as COLMAP does, for example on a network disk."""
    file = folder / "test.db"
    try:
        with closing(sqlite3.connect(file)) as opened:
            opened.execute("PRAGMA journal_mode = WAL")
            opened.execute("CREATE TABLE test (data BLOB)")
            opened.execute("INSERT INTO test VALUES (zeroblob(100000))")
            opened.commit()
    except sqlite3.Error as error:
        raise StoreError(
            f"the disk of {folder} cannot hold the database of COLMAP ({error})",
            hint="choose a --store on another disk; the run may stay on this one",
        ) from error
    finally:
        for leftover in folder.glob("test.db*"):
            leftover.unlink()


def _follow(child: subprocess.Popen[str], reporter: Reporter) -> StageError | None:
    """Show the child's reports until it closes its output. Return the error that it reported, or None."""
    assert child.stdout is not None
    failure: StageError | None = None
    with ExitStack() as phases:
        task: Task | None = None
        for line in child.stdout:
            message = json.loads(line)
            child_used(message["cpu"])
            if "phase" in message:
                phases.close()
                task = phases.enter_context(reporter.task(message["phase"], message["total"]))
            elif "error" in message:
                failure = StageError(message["error"], hint=message["hint"])
            elif task is not None:
                task.update(done=message["done"])
        child.wait()  # its time since the last report belongs to the last phase
        child_used(0.0)
    return failure


def _last_failure(log: Path) -> str:
    """Return the cause of a failure: COLMAP's last failed check, else the last line of the log."""
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines()]
    lines = [line for line in lines if line and not line.startswith(("@", "***"))]
    checks = [line for line in lines if re.match(r"F\d{8} ", line)]
    chosen = (checks or lines or ["no reason was given"])[-1]
    return chosen.split("] ", 1)[-1][:200]
