"""The five stages, in order. The runner loads ``cleargs.stages.<name>`` by name; each module fulfils
`cleargs.pipeline.stage.Stage`.
"""

from __future__ import annotations

from collections.abc import Callable

STAGES = ("ingest", "rva", "g0", "rivr", "consolidate")


def pace(say: Callable[[str], None] | None = None) -> float:
    """This machine's time over that of the one on which the stages' estimates were measured."""
    from cleargs.splat.pace import machine_pace

    return machine_pace(say)
