"""Where Numba keeps what it compiled: never in the package, which may be read-only or shared."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path


def cache_folder(name: str) -> Path:
    """A writable folder ``name`` for compiled kernels, made if needed.

    Below ``NUMBA_CACHE_DIR`` where that is set, else below the user's cache folder (``XDG_CACHE_HOME``
    or ``~/.cache``), else, when none can be written to, a fresh temporary folder.
    """
    own = f"{os.environ.get('XDG_CACHE_HOME') or '~/.cache'}/cleargs"
    for candidate in filter(None, (os.environ.get("NUMBA_CACHE_DIR"), own)):
        with suppress(OSError, RuntimeError):  # RuntimeError: expanduser without a home
            folder = Path(candidate).expanduser() / name
            folder.parent.mkdir(parents=True, exist_ok=True)
            folder.mkdir(mode=0o700, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
    return Path(tempfile.mkdtemp(prefix=f"cleargs-{name}-"))


def configure_numba(name: str) -> None:
    """Point Numba at the folder ``name`` of the cache and at a threading layer; to be called before a kernel
    is defined.

    OpenMP is preferred (any Python thread may start a kernel); where it is missing Numba falls back to
    its own work queue, for which ``jit.LAUNCHING`` keeps launches apart.
    """
    from numba import config

    # By setattr, because Numba makes these settings from the environment and declares none of them.
    settings = {"CACHE_DIR": str(cache_folder(name)), "THREADING_LAYER_PRIORITY": ["omp", "tbb", "workqueue"]}
    for setting, value in settings.items():
        setattr(config, setting, value)
