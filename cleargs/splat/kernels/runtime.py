"""How the CPU kernels are cached, threaded and compiled ahead of use."""

from __future__ import annotations

import hashlib
from pathlib import Path

from cleargs import kernel_cache


def kernel_digest() -> str:
    """Digest of every source file that ends up in compiled kernels.

    Numba's own cache is keyed by the file of the kernel itself and misses changes in functions that it
    calls from other files; a folder named by this digest does not.
    """
    folder = Path(__file__).parent
    sources = [
        folder.parent / "constants.py",
        *sorted(folder.glob("*.py")),  # the layouts, whose numbers are compiled in
        *sorted((folder / "cpu").glob("*.py")),
    ]
    digest = hashlib.sha256()
    for source in sources:
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def configure_numba() -> None:
    """Give the kernels a folder of the cache and a threading layer; to be called before one is defined."""
    kernel_cache.configure_numba(f"kernels-{kernel_digest()}")


def set_threads(n: int) -> None:
    """Run the kernels on ``n`` threads from now on (for the calling Python thread).

    At most as many as Numba started, which is the number of cores or ``NUMBA_NUM_THREADS``. Results do
    not depend on it. torch's threads are set on their own, by ``torch.set_num_threads``.

    Raises:
        ValueError: when ``n`` is less than 1.
    """
    from cleargs.splat.kernels.cpu import launch

    launch.set_threads(n)


def warm_up() -> None:
    """Compile every CPU kernel, or load it from the cache, by running each once on a tiny scene."""
    from cleargs.splat.kernels.cpu import warmup

    warmup.run()
