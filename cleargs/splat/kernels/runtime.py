"""How the CPU kernels are cached, threaded and compiled ahead of use."""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path


def kernel_digest() -> str:
    """Digest of every source file that ends up in compiled kernels.

    Numba's own cache is keyed by the file of the kernel itself and misses changes in functions that it
    calls from other files; a folder named by this digest does not.
    """
    folder = Path(__file__).parent
    sources = [folder.parent / "constants.py", *sorted((folder / "cpu").glob("*.py"))]
    digest = hashlib.sha256()
    for source in sources:
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """A writable folder for compiled kernels, made if needed.

    Below ``NUMBA_CACHE_DIR`` where that is set, else below the user's cache folder (``XDG_CACHE_HOME``
    or ``~/.cache``), else, when none can be written to, a fresh temporary folder. One that others own or may
    write to is passed over: what lies there is run.
    """
    name = f"kernels-{kernel_digest()}"
    candidates = []
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        candidates.append(Path(chosen))
    if shared := os.environ.get("XDG_CACHE_HOME"):
        candidates.append(Path(shared) / "cleargs")
    candidates.append(Path("~/.cache/cleargs"))
    for candidate in candidates:
        try:
            folder = candidate.expanduser() / name
            folder.parent.mkdir(parents=True, exist_ok=True)
            folder.mkdir(mode=0o700, exist_ok=True)
            if not _private(folder):
                continue
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except (OSError, RuntimeError):  # RuntimeError: expanduser without a home
            continue
    return Path(tempfile.mkdtemp(prefix="cleargs-kernels-"))


def _private(folder: Path) -> bool:
    """Whether nobody but the user (and root) can put something into ``folder``."""
    status = folder.lstat()
    return (
        stat.S_ISDIR(status.st_mode)
        and status.st_uid == os.geteuid()
        and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    )


def configure_numba() -> None:
    """Point Numba at the cache folder and at a threading layer; to be called before a kernel is defined.

    OpenMP is preferred (any Python thread may start a kernel); where it is missing Numba falls back to
    its own work queue, for which ``launch_lock`` keeps launches apart.
    """
    from numba import config

    # By setattr, because Numba makes these settings from the environment and declares none of them.
    settings = {"CACHE_DIR": str(cache_folder()), "THREADING_LAYER_PRIORITY": ["omp", "tbb", "workqueue"]}
    for name, value in settings.items():
        setattr(config, name, value)


def set_threads(n: int) -> None:
    """Run the kernels on ``n`` threads from now on (for the calling Python thread).

    At most as many as Numba started, which is the number of cores or ``NUMBA_NUM_THREADS``. Results do
    not depend on it. torch's threads are set on their own, by ``torch.set_num_threads``.

    Raises:
        ValueError: when ``n`` is less than 1.
    """
    from cleargs.splat.kernels.cpu import launch

    launch.set_threads(n)


def warm_up(progress: Callable[[str, int, int], None] | None = None) -> None:
    """Compile every CPU kernel, or load it from the cache, by running each once on a tiny scene.

    ``progress(name, done, total)`` is called before each kernel and, with ``done == total``, at the end.
    """
    from cleargs.splat.kernels.cpu import warmup

    steps = warmup.steps()
    for done, (name, run) in enumerate(steps):
        if progress is not None:
            progress(name, done, len(steps))
        run()
    if progress is not None:
        progress("done", len(steps), len(steps))
