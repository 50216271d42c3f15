"""File locks that end with their process.

They avoid double work. Correctness does not depend on them: it comes from the rename that publishes a result.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from cleargs.files import disk_errors
from cleargs.progress import Reporter


@contextmanager
def file_lock(path: Path, *, shared: bool = False, wait: bool = True) -> Iterator[bool | None]:
    """Hold the lock file ``path`` for the block. The kernel releases the lock when the process ends.

    Several processes may hold a ``shared`` lock. Without ``wait``, the block also runs without the lock.
    Yields True with the lock, False without it, None on a file system without locks.
    """
    while True:
        with disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            held = _acquire(handle, shared=shared, wait=wait)
            present = None
            with suppress(FileNotFoundError):
                present = path.stat().st_ino
            if held and present != os.fstat(handle).st_ino:
                continue  # the last holder removed the file while this process waited: lock the new one
            yield held
            return
        finally:
            os.close(handle)


@contextmanager
def exclusive_lock(path: Path, reporter: Reporter, what: str) -> Iterator[bool]:
    """Hold the lock file ``path``; report another holder of the work ``what`` and wait for it.

    The holder writes its process and host into the file. Yields True with the lock; False on a file system
    without locks, where other processes may do the same work.
    """
    with ExitStack() as stack:
        held = stack.enter_context(file_lock(path, wait=False))
        if held is False:
            holder = ""
            with suppress(OSError, UnicodeDecodeError):
                holder = path.read_text(encoding="utf-8")
            reporter.info(f"{what}: {holder or 'another process'} works on it; waiting for it to end")
            held = stack.enter_context(file_lock(path))
        job = f" (Slurm job {os.environ['SLURM_JOB_ID']})" if os.environ.get("SLURM_JOB_ID") else ""
        with suppress(OSError):  # only messages use the note
            path.write_text(f"process {os.getpid()} on {socket.gethostname()}{job}", encoding="utf-8")
        yield held is not None


def is_locked(path: Path) -> bool:
    """Return True if a process holds an exclusive lock on ``path``, or if the file system has no locks."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        return _acquire(handle, shared=True, wait=False) is not True
    finally:
        os.close(handle)


def _acquire(handle: int, *, shared: bool, wait: bool) -> bool | None:
    try:
        import fcntl
    except ImportError:  # a Python without it: as on a file system without locks
        return None
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(handle, kind if wait else kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True
