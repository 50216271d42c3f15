"""The five stages, in order.

The runner loads ``cleargs.stages.<name>`` by name. Each module implements `cleargs.pipeline.stage.Stage`.
"""

from __future__ import annotations

STAGES = ("ingest", "rva", "g0", "rivr", "consolidate")


def gpu_fault(error: BaseException) -> str | None:
    """Return in one line what failed on the GPU if that is the cause of ``error``, else None."""
    from cleargs.splat.kernels.cuda.support import gpu_fault

    return gpu_fault(error)
