"""Locks that die with their holder. They save work; correctness rests on the rename that publishes."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def file_lock(path: Path, *, shared: bool = False, wait: bool = True) -> Iterator[bool]:
    """Hold the lock file ``path`` (created when absent) for the block; yields whether it is held.

    The kernel drops the lock when its process ends, however it ends, so a stale lock file blocks nobody.
    Another holder is waited for; with ``wait=False`` the block runs with False instead. On a file system
    without locks the block runs as if the lock were held.
    """
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            held = _acquire(handle, kind, wait=wait)
            if held and not _still_there(path, handle):
                continue  # its last holder removed the file while we waited: lock the new one
            yield held
            return
        finally:
            os.close(handle)


def _acquire(handle: int, kind: int, *, wait: bool) -> bool:
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
        return True
    except BlockingIOError:
        if not wait:
            return False
    except OSError:
        return True
    fcntl.flock(handle, kind)
    return True


def _still_there(path: Path, handle: int) -> bool:
    try:
        return path.stat().st_ino == os.fstat(handle).st_ino
    except FileNotFoundError:
        return False
