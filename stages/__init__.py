"""The five stages, in order.

The runner loads ``cleargs.stages.<name>`` by name. Each module implements `cleargs.pipeline.stage.Stage`.
"""

from __future__ import annotations

from collections.abc import Collection

STAGES = ("ingest", "rva", "g0", "rivr", "consolidate")
TRAININGS = frozenset({"g0", "rivr", "consolidate"})


def prepare(names: Collection[str]) -> None:
    """Start what the stages ``names`` will need on the CPU, next to those before them."""
    if TRAININGS.intersection(names):
        from cleargs.splat import compilation

        compilation.begin()


def gpu_fault(error: BaseException) -> str | None:
    """Return one line about the GPU failure that caused ``error``; None if the GPU is not the cause."""
    from cleargs.splat.kernels.cuda.support import gpu_fault

    return gpu_fault(error)
