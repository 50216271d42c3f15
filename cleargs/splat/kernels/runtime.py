"""Threads of the CPU kernels, and compiling them ahead of use."""

from __future__ import annotations


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
    from cleargs.splat.kernels.cpu import backend

    backend.warm_up()
