"""How the CPU kernels are compiled.

The fast-math flags leave out ``nnan`` and ``ninf``, so comparisons with NaN and infinity keep working, and
``reassoc``: Numba compiles the body of a parallel loop twice, alone for the process at hand and as a part of
the kernel for the cache, and with it the two round differently. A training resumed by another process would
then end in other bits than one that was not interrupted.
Every kernel walks over items or blocks of a fixed size, and an item's arithmetic does not depend on
its neighbours in the loop, which makes results bitwise independent of the number of threads.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import njit

from cleargs import kernel_cache

F = TypeVar("F", bound=Callable[..., Any])


FAST = frozenset({"contract", "nsz", "arcp"})

LAUNCHING = threading.RLock()
"""Held around a group of kernels. The threads are one resource of the process: Numba's work queue, the layer
where OpenMP is missing, aborts when two Python threads launch kernels at once."""


def kernel_digest() -> str:
    """Digest of every source file that ends up in compiled kernels.

    Numba's own cache is keyed by the file of the kernel itself and misses changes in functions that it
    calls from other files; a folder named by this digest does not.
    """
    folder = Path(__file__).parent
    digest = hashlib.sha256()
    for source in (
        folder.parents[1] / "constants.py",
        *sorted(folder.parent.glob("*_layout.py")),  # their numbers are compiled in
        *sorted(folder.glob("*.py")),
    ):
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def configure_numba() -> None:
    """Give the kernels a folder of the cache and a threading layer; to be called before one is defined."""
    kernel_cache.configure_numba(f"kernels-{kernel_digest()}")


def kernel(function: F) -> F:
    """A parallel entry point: called from Python, cached on disk, runs without the GIL."""
    return cast(
        F, njit(cache=True, parallel=True, nogil=True, fastmath=set(FAST), error_model="numpy")(function)
    )


def serial_kernel(function: F) -> F:
    """An entry point that runs on the calling thread alone."""
    return cast(F, njit(cache=True, nogil=True, error_model="numpy")(function))


def device(function: F) -> F:
    """A function that kernels call; compiled into them."""
    return cast(F, njit(fastmath=set(FAST), error_model="numpy")(function))


def inlined(function: F) -> F:
    """A small function that LLVM must inline, so that SIMD values stay in registers."""
    return cast(F, njit(fastmath=set(FAST), error_model="numpy", forceinline=True)(function))


def exact(function: F) -> F:
    """Plain IEEE arithmetic: bitwise the same wherever it is compiled into."""
    return cast(F, njit(error_model="numpy")(function))
