"""File locks that end with their process.

They avoid double work. Correctness does not depend on them: it comes from the rename that publishes a result.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from cleargs.files import acquire_lock, disk_errors
from cleargs.progress import Reporter
from cleargs.safe_io import open_own, read_bytes

MAX_NOTE_BYTES = 4096
"""Maximum size of the note in a lock file that is read."""


@contextmanager
def file_lock(path: Path, *, shared: bool = False, wait: bool = True) -> Iterator[bool | None]:
    """Hold the lock file ``path`` for the block. The kernel releases the lock when the process ends.

    Several processes may hold a ``shared`` lock. Without ``wait``, the block also runs without the lock.
    Yields True with the lock, False without it, None on a file system without locks.
    """
    while True:
        with disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = open_own(path, path.parent, os.O_RDWR | os.O_CREAT)
        try:
            held = acquire_lock(handle, shared=shared, wait=wait)
            present = None
            with suppress(FileNotFoundError):
                present = path.lstat().st_ino
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
                holder = read_bytes(path, MAX_NOTE_BYTES, root=path.parent).decode()
            reporter.info(f"{what}: {holder or 'another process'} works on it; waiting for it to end")
            held = stack.enter_context(file_lock(path))
        job = f" (Slurm job {os.environ['SLURM_JOB_ID']})" if os.environ.get("SLURM_JOB_ID") else ""
        with suppress(OSError):  # only messages use the note
            _write_note(path, f"process {os.getpid()} on {socket.gethostname()}{job}")
        yield held is not None


def _write_note(path: Path, note: str) -> None:
    """Write the note of a holder. A file with other content, or with a second name, is not ours and stays."""
    with os.fdopen(open_own(path, path.parent, os.O_RDWR), "r+b") as file:
        status = os.fstat(file.fileno())
        if status.st_nlink == 1 and (not status.st_size or file.read(8) == b"process "):
            file.seek(0)
            file.truncate()
            file.write(note.encode())


def is_locked(path: Path) -> bool:
    """Return True if a process holds an exclusive lock on ``path``, or if the file system has no locks."""
    try:
        handle = open_own(path, path.parent)
    except OSError:
        return False
    try:
        return acquire_lock(handle, shared=True, wait=False) is not True
    finally:
        os.close(handle)
