"""Snakemake as the engine: found in an environment of its own, started once at a time for a batch."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.resources import files
from pathlib import Path

from cleargs.batch.folder import BatchFolder
from cleargs.errors import InputError, StageError, StoreError

ENGINE_VARIABLE = "CLEARGS_SNAKEMAKE"
PROFILES = ("local", "slurm")
LOOK_EVERY = 1.0
"""Seconds between two looks at how far the scenes are."""
REST = 10.0
"""At least so many times as long as a look took: a thousand scenes are thousands of small files."""
LEAVE = 20.0
"""Seconds that an interrupted engine gets. It takes back its jobs at once, but ends only after its next look
at them, which may be three minutes away."""
GLANCE = 1.0
"""Seconds that a new batch tries to take the lock: whoever asks for the state holds it for an instant."""
WORKING = "process {} on {}"
INTERRUPTED = re.compile(r"process (\d+) on (.+), interrupted at (\d+)")
"""What the lock file says of an engine."""


def find_snakemake() -> Path:
    """The ``snakemake`` to use: $CLEARGS_SNAKEMAKE, ``.venv-cluster`` beside this environment, the PATH.

    Raises InputError where there is none.
    """
    named = os.environ.get(ENGINE_VARIABLE)
    if named:
        if not (Path(named).is_file() and os.access(named, os.X_OK)):
            raise InputError(
                f"${ENGINE_VARIABLE} names {named}, which is no program",
                hint="let it name the snakemake of an environment",
            )
        return Path(named)
    beside = Path(sys.prefix).parent / ".venv-cluster" / "bin" / "snakemake"
    on_path = shutil.which("snakemake")
    if not beside.exists() and on_path is None:
        raise InputError(
            "Snakemake, which runs batches, is not installed",
            hint="`make cluster` in the checkout, or install snakemake and its plugin executor-slurm in an "
            f"environment of their own and let ${ENGINE_VARIABLE} name its snakemake",
        )
    return beside if beside.exists() else Path(str(on_path))


def profile_folder(profile: str) -> Path:
    """The folder of a profile: one that comes with ClearGS by name, or one of your own by path."""
    folder = _workflows() / "profiles" / profile if profile in PROFILES else Path(profile).absolute()
    if not (folder / "config.yaml").is_file():
        raise InputError(
            f"there is no profile {profile}",
            hint=f"choose {' or '.join(PROFILES)}, or give a folder with a config.yaml",
        )
    return folder


def is_local(profile: Path) -> bool:
    """Whether ``profile`` is the one for this machine."""
    return profile == _workflows() / "profiles" / "local"


def engine_command(folder: BatchFolder, profile: Path, *, cores: int, dry_run: bool = False) -> list[str]:
    """The call of Snakemake. ``cores`` bounds jobs on this machine and holds nothing back on a cluster."""
    command = [str(find_snakemake()), "--snakefile", str(_workflows() / "Snakefile")]
    command += ["--directory", str(folder.root), "--profile", str(profile), "--workflow-profile", "none"]
    command += ["--cores", str(cores)] if is_local(profile) else []
    plan = f"plan={folder.plan(dry_run=True).name}"
    return command + (["--dry-run", "--quiet", "--config", plan] if dry_run else [])


@contextmanager
def only_batch(folder: BatchFolder) -> Iterator[int]:
    """Be the only batch at work in ``folder``; yields the lock's handle, which the engine is to inherit.

    The lock lives as long as the engine, also where the command that started it was killed; one that was
    interrupted is waited for. Raises StageError when
    another batch is at work, StoreError when the folder cannot be made.
    """
    try:
        folder.root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"cannot make {folder.root}: {error.strerror}", hint="choose another -o") from error
    handle = os.open(folder.root / "batch.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        if not (_take(handle, patience=GLANCE) or _take_after_interrupted(handle, folder)):
            engine = _read_lock(handle)
            raise StageError(
                f"a batch of this sheet is at work already{f' ({engine})' if engine else ''}",
                hint="watch it with cleargs batch-status; it may be interrupted, what is done is kept",
            )
        yield handle
    finally:
        os.close(handle)


def run_engine(command: Sequence[str], folder: BatchFolder, lock: int, look: Callable[[], None]) -> int:
    """Run Snakemake to its end, its words in the engine's log; ``look`` is called every now and then.

    Returns its exit code. An interruption is passed on to it and all that it started here: it then takes back
    what it gave to a cluster.
    """
    folder.engine_log.parent.mkdir(parents=True, exist_ok=True)
    # It starts Pythons of its own in the batch folder: nothing is to be imported from there.
    environment = {**os.environ, "PYTHONSAFEPATH": "1"}
    with folder.engine_log.open("ab") as log:
        if _locked(folder):
            # We are the only batch, so this lock was left by an engine that was killed.
            unlock = [*command, "--unlock"]
            subprocess.run(
                unlock, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, check=False
            )
        engine = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            pass_fds=(lock,),
            env=environment,
            start_new_session=True,  # so that a Ctrl-C reaches it once, from here
        )
        working = WORKING.format(engine.pid, socket.gethostname())
        _write_lock(lock, working)
        try:
            pause = LOOK_EVERY
            while not _ended(engine, pause):
                begin = time.monotonic()
                look()
                pause = max(LOOK_EVERY, REST * (time.monotonic() - begin))
        except KeyboardInterrupt:
            _write_lock(lock, f"{working}, interrupted at {time.time():.0f}")
            os.killpg(engine.pid, signal.SIGINT)
            raise
    look()
    return engine.returncode


def engine_at_work(folder: BatchFolder) -> str | None:
    """Which engine holds the lock, also one whose command was killed; None when none does, or locks fail."""
    try:
        handle = os.open(folder.root / "batch.lock", os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        return None if _take(handle, fcntl.LOCK_SH) else _read_lock(handle)
    finally:
        os.close(handle)


def _ended(engine: subprocess.Popen[bytes], seconds: float) -> bool:
    """Whether the engine ended within ``seconds``."""
    try:
        engine.wait(seconds)
        return True
    except subprocess.TimeoutExpired:
        return False


def _take(lock: int, kind: int = fcntl.LOCK_EX, *, patience: float = 0.0) -> bool:
    """Try to take the lock for ``patience`` seconds; whether it is ours, or the file system has no locks."""
    deadline = time.monotonic() + patience
    while True:
        try:
            fcntl.flock(lock, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= deadline:
                return False
            time.sleep(0.02)
        except OSError:
            return True
        else:
            return True


def _take_after_interrupted(lock: int, folder: BatchFolder) -> bool:
    """Take the lock from an engine of this host that was interrupted: wait for its end, then end it.

    That loses nothing: what it may have left at work on a cluster is taken for what it is, work of others.
    """
    found = INTERRUPTED.fullmatch(_read_lock(lock))
    if found is None or found[2] != socket.gethostname():
        return False
    while time.time() < int(found[3]) + LEAVE:
        if _take(lock):
            return True
        time.sleep(0.2)
    with suppress(OSError):
        # Containers may share a host's name, but not its processes.
        if str(folder.root).encode() in Path(f"/proc/{found[1]}/cmdline").read_bytes():
            os.killpg(int(found[1]), signal.SIGKILL)
    time.sleep(0.5)
    return _take(lock)


def _read_lock(lock: int) -> str:
    return os.pread(lock, 200, 0).decode()


def _write_lock(lock: int, text: str) -> None:
    os.ftruncate(lock, 0)
    os.pwrite(lock, text.encode(), 0)


def _locked(folder: BatchFolder) -> bool:
    locks = folder.root / ".snakemake" / "locks"
    return locks.is_dir() and any(locks.iterdir())


def _workflows() -> Path:
    return Path(str(files("cleargs.workflows")))
