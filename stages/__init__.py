"""The five stages, in order.

The runner loads ``cleargs.stages.<name>`` by name. Each module implements `cleargs.pipeline.stage.Stage`.
"""

from __future__ import annotations

from collections.abc import Callable

STAGES = ("ingest", "rva", "g0", "rivr", "consolidate")


def pace(say: Callable[[str], None] | None = None) -> float:
    """Return the time of this machine relative to the machine on which the estimates were measured."""
    from cleargs.splat.pace import machine_pace

    return machine_pace(say)


def gpu_fault(error: BaseException) -> str | None:
    """Return one line about the GPU failure that caused ``error``; None if the GPU is not the cause."""
    from cleargs.splat.kernels.cuda.support import gpu_fault

    return gpu_fault(error)
