"""Leases: who is at work, said by a file with a heartbeat, where no lock of the file system can be trusted.

A lease tells others whether waiting is worth it; it protects nothing. What protects results is that work
folders and results change hands by rename alone.
"""

from __future__ import annotations

import errno
import os
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, astuple, dataclass
from pathlib import Path

from cleargs.files import write_json
from cleargs.untrusted import FAULTS, read_json

BEAT = 10.0
"""Seconds between two heartbeats."""
DEAD_AFTER = 120.0
"""Seconds without one after which the holder counts as dead; long calls into compiled code delay a beat."""


@dataclass(frozen=True)
class Holder:
    """A process that holds a lease."""

    host: str
    pid: int
    pid_space: str
    """Where on the host the pid means something: containers count their own. "" where unknown."""
    born: str
    """When the process began, by the host's own count; pids come back. "" where unknown."""
    job: str
    """Id of its Slurm job; "" outside Slurm."""


_KINDS = (str, int, str, str, str)
"""Types of the fields of a `Holder`."""


def this_process() -> Holder:
    """The holder that this process is."""
    job = os.environ.get("SLURM_JOB_ID", "")
    return Holder(socket.gethostname(), os.getpid(), _pid_space(), _born(os.getpid()), job)


@contextmanager
def lease(path: Path) -> Iterator[None]:
    """Hold the lease ``path`` for the block, its time stamp renewed every `BEAT` seconds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, asdict(this_process()))
    ended = threading.Event()
    threading.Thread(target=_beat, args=(path, ended), name="lease", daemon=True).start()
    try:
        yield
    finally:
        ended.set()
        with suppress(OSError):
            path.unlink()


def living_holder(path: Path) -> Holder | None:
    """Who holds the lease ``path``; None where nobody does, or where its holder is dead.

    Of a process of this host the kernel knows. Elsewhere dead are an earlier try of this process's own Slurm
    job, and whoever gave no heartbeat for `DEAD_AFTER` seconds by the clock of the file system.
    """
    try:
        holder = Holder(**read_json(path))
        beat = path.stat().st_mtime
    except FAULTS:
        return None
    if not all(isinstance(value, kind) for value, kind in zip(astuple(holder), _KINDS, strict=True)):
        return None
    here = this_process()
    if holder.born and (holder.host, holder.pid_space) == (here.host, here.pid_space):
        return holder if _born(holder.pid) == holder.born else None
    if here.job and holder.job == here.job and holder.host != here.host:
        return None
    # A beat from the future is no sign of life either: a clock was wrong, or the time stamp is a lie.
    return holder if abs(_now(path.parent) - beat) < DEAD_AFTER else None


def _beat(path: Path, ended: threading.Event) -> None:
    while not ended.wait(BEAT):
        with suppress(OSError):
            os.utime(path)


def _pid_space() -> str:
    try:
        return str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        return ""


def _born(pid: int) -> str:
    """Start time of a process, clock ticks since boot; "" when it has ended, or where there is no /proc."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if fields[0] == "Z" else fields[19]  # a zombie has ended, its parent has not noticed


def _now(folder: Path) -> float:
    """The time by the clock that stamps files in ``folder``: that of the file server. This node's for whoever
    may not write there, and so can only look at another's run: nobody is taken for dead by it and robbed."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder) as file:
            return os.fstat(file.fileno()).st_mtime
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise
        return time.time()
