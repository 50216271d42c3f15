"""The five stages, in order.

The runner loads ``cleargs.stages.<name>`` by name. Each module implements `cleargs.pipeline.stage.Stage`.
"""

from __future__ import annotations

STAGES = ("ingest", "rva", "g0", "rivr", "consolidate")


def gpu_fault(error: BaseException) -> str | None:
    """Return one line about the GPU failure that caused ``error``; None if the GPU is not the cause."""
    from cleargs.splat.kernels.cuda.support import gpu_fault

    return gpu_fault(error)
