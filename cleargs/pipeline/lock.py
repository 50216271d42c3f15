"""File locks that end with their process. They save work; correctness rests on the rename that publishes."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from cleargs.files import disk_errors
from cleargs.progress import Reporter


@contextmanager
def file_lock(path: Path, *, shared: bool = False, wait: bool = True) -> Iterator[bool | None]:
    """Hold the lock file ``path`` (created when absent) for the block.

    Yields True, or None on a file system without locks. The kernel drops the lock when its process ends,
    however it ends. Another holder is waited for; with ``wait=False`` the block runs with False instead.
    """
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    while True:
        with disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            held = _acquire(handle, kind if wait else kind | fcntl.LOCK_NB)
            there = None
            with suppress(FileNotFoundError):
                there = path.stat().st_ino
            if held and there != os.fstat(handle).st_ino:
                continue  # its last holder removed the file while we waited: lock the new one
            yield held
            return
        finally:
            os.close(handle)


@contextmanager
def only_one(path: Path, reporter: Reporter, what: str) -> Iterator[bool]:
    """Hold the lock file ``path`` of ``what``; wait while another process has it, and say which one.

    Yields whether this process is alone: a file system without locks keeps nobody apart.
    """
    with ExitStack() as stack:
        held = stack.enter_context(file_lock(path, wait=False))
        if held is False:
            holder = ""
            with suppress(OSError, UnicodeDecodeError):
                holder = path.read_text(encoding="utf-8")
            reporter.info(f"{what}: {holder or 'another process'} works on it; waiting")
            held = stack.enter_context(file_lock(path))
        job = f" (Slurm job {os.environ['SLURM_JOB_ID']})" if os.environ.get("SLURM_JOB_ID") else ""
        with suppress(OSError):  # the note only serves messages
            path.write_text(f"process {os.getpid()} on {socket.gethostname()}{job}", encoding="utf-8")
        yield held is not None


def is_locked(path: Path) -> bool:
    """Return True if a process holds ``path`` alone, or if nobody can tell."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        return _acquire(handle, fcntl.LOCK_SH | fcntl.LOCK_NB) is not True
    finally:
        os.close(handle)


def _acquire(handle: int, kind: int) -> bool | None:
    try:
        fcntl.flock(handle, kind)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True
