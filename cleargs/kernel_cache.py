"""Cache folder of Numba's compiled kernels, outside the package, which may be read-only or shared."""

from __future__ import annotations

import hashlib
import os
import tempfile
from contextlib import suppress
from pathlib import Path


def cache_folder(name: str) -> Path:
    """Return a writable folder ``name`` for compiled kernels: `lasting_folder`, else a new temporary one."""
    return lasting_folder(name) or Path(tempfile.mkdtemp(prefix=f"cleargs-{name}-"))


def lasting_folder(name: str) -> Path | None:
    """Return the folder ``name`` for compiled kernels that all processes share, creating it if necessary.

    It is in ``NUMBA_CACHE_DIR`` if that is set, else in the user's cache folder (``XDG_CACHE_HOME`` or
    ``~/.cache``). None if neither is writable.
    """
    own = f"{os.environ.get('XDG_CACHE_HOME') or '~/.cache'}/cleargs"
    for candidate in filter(None, (os.environ.get("NUMBA_CACHE_DIR"), own)):
        with suppress(OSError, RuntimeError):  # RuntimeError: expanduser without a home
            folder = Path(candidate).expanduser() / name
            folder.parent.mkdir(parents=True, exist_ok=True)
            folder.mkdir(mode=0o700, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
    return None


def installation() -> str:
    """Return a digest of the paths and modification times of the kernels' sources.

    Numba compiles again if one of them differs, for example in another environment with the same program.
    """
    sources = sorted(Path(__file__).parent.glob("splat/kernels/cpu/*.py"))
    stamps = repr([(str(source), source.stat().st_mtime_ns) for source in sources])
    return hashlib.sha256(stamps.encode()).hexdigest()[:8]


def configure_numba(name: str) -> None:
    """Set Numba's cache folder and threading layer. Call this before any kernel is defined.

    OpenMP is preferred, since any Python thread may start a kernel. Without it Numba uses its own work queue,
    for which ``jit.LAUNCHING`` serialises launches.
    """
    from numba import config

    # By setattr, because Numba creates these settings at run time and declares none of them.
    settings = {"CACHE_DIR": str(cache_folder(name)), "THREADING_LAYER_PRIORITY": ["omp", "tbb", "workqueue"]}
    for setting, value in settings.items():
        setattr(config, setting, value)
