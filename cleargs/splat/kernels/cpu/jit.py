"""Decorators that compile the CPU kernels, and the name of their cache.

The fast-math flags leave out ``nnan`` and ``ninf``, so comparisons with NaN and infinity keep working. They
also leave out ``reassoc``. Numba compiles the body of a parallel loop twice: alone for the current process,
and as a part of the kernel for the cache. With ``reassoc`` the two round differently, and a training that
another process resumes would end with other bits than an uninterrupted one. ``contract`` can do the same to a
sum of two products, since either product may be fused with the sum: see `unfused`.

Every kernel loops over items or blocks of a fixed size, and the arithmetic of an item does not depend on its
neighbours in the loop. Results are therefore bitwise independent of the number of threads.
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
"""Lock to hold around a group of kernels. Without OpenMP, Numba uses its ``workqueue`` layer, which aborts if
two Python threads launch kernels at once."""


def kernel_digest() -> str:
    """Return a digest of every source file that is compiled into kernels.

    Numba keys its cache by the file of the kernel and misses changes in functions that the kernel calls from
    other files. A cache folder that is named by this digest does not miss them.
    """
    folder = Path(__file__).parent
    digest = hashlib.sha256()
    for source in (
        folder.parents[1] / "constants.py",
        *sorted(folder.parent.glob("*_layout.py")),  # their constants are compiled in
        *sorted(folder.glob("*.py")),
    ):
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def compiled_mark(device: str) -> Path:
    """Return the file that says that all kernels for ``device`` have been compiled once on this machine."""
    name = f"compiled-{device}-{kernel_cache.installation()}"
    return kernel_cache.cache_folder(f"kernels-{kernel_digest()}") / name


def is_compiled(device: str) -> bool:
    """Return True if all kernels for ``device`` have been compiled on this machine."""
    return compiled_mark(device).exists()


def configure_numba() -> None:
    """Set the cache folder and the threading layer of the kernels; call it before one is defined."""
    kernel_cache.configure_numba(f"kernels-{kernel_digest()}")


def kernel(function: F) -> F:
    """Compile a parallel entry point: called from Python, cached on disk, runs without the GIL."""
    return cast(
        F, njit(cache=True, parallel=True, nogil=True, fastmath=set(FAST), error_model="numpy")(function)
    )


def serial_kernel(function: F) -> F:
    """Compile an entry point that runs on the calling thread only."""
    return cast(F, njit(cache=True, nogil=True, error_model="numpy")(function))


def inlined(function: F) -> F:
    """Compile a function that LLVM must inline into its caller.

    Tuples and SIMD values then stay in registers, and LLVM can vectorise a loop that calls the function.
    """
    return cast(F, njit(fastmath=set(FAST), error_model="numpy", forceinline=True)(function))


def unfused(function: F) -> F:
    """Compile like `inlined`, but with a rounding after each operation, so that all callers round alike.

    It is for loops over Gaussians whose sums have several products.
    """
    flags = FAST - {"contract"}
    return cast(F, njit(fastmath=set(flags), error_model="numpy", forceinline=True)(function))


def exact(function: F) -> F:
    """Compile with plain IEEE arithmetic: the result is bitwise the same in every caller."""
    return cast(F, njit(error_model="numpy")(function))
