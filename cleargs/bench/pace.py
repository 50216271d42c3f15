"""How fast this machine is beside the one on which the costs of the stages were measured.

``python -m cleargs.bench.pace`` prints the milliseconds that a training iteration takes here, on one thread.
On the reference machine, quiet or not, that gives `REFERENCE_MS`; it and the constants of the stages'
``estimate`` belong together and are made again together (docs/experiments/speed.md).
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from cleargs.bench.processor import processor_name
from cleargs.children import module_command
from cleargs.errors import StoreError
from cleargs.files import write_json
from cleargs.kernel_cache import cache_folder
from cleargs.untrusted import FAULTS, read_json

PROBE = 1
"""Raised with whatever changes the milliseconds on one and the same machine: others are not read then."""

SPLATS, WIDTH, HEIGHT = 50_000, 640, 360
REPEATS = 12

REFERENCE_MS = 80.0
"""Of an iteration on the reference machine: a core of an Intel Xeon (Emerald Rapids, AVX-512)."""

PATIENCE_S = 300
"""Two seconds of work; where no kernel is compiled yet, half a minute and more."""


def machine_pace(say: Callable[[str], None] | None = None) -> float:
    """This machine's time over that of the reference machine; 1 where nothing is known of it.

    Remembered from an earlier measurement. Without one it is measured where somebody is told so (``say``).
    """
    pace = remembered_pace()
    if pace is not None or say is None:
        return 1.0 if pace is None else pace
    say("measuring the pace of this machine (once; kernels may have to be compiled for it)")
    milliseconds = _measured()
    if milliseconds is None:
        return 1.0
    with suppress(StoreError):
        write_json(_note(), {**_machine(), "milliseconds": milliseconds})
    return milliseconds / REFERENCE_MS


def remembered_pace() -> float | None:
    """What was measured on this machine before; None where nothing was, or the note of it is damaged."""
    try:
        return _sound(read_json(_note())["milliseconds"]) / REFERENCE_MS
    except FAULTS:
        return None


def _machine() -> dict[str, str | int]:
    """What has a pace of its own."""
    return {"host": platform.node(), "processor": processor_name(), "probe": PROBE}


def _note() -> Path:
    """A file a machine: a cluster's machines share their home."""
    name = hashlib.sha256(json.dumps(_machine(), sort_keys=True).encode()).hexdigest()[:16]
    return cache_folder("pace") / f"{name}.json"


def _measured() -> float | None:
    """In a process of its own: neither its memory nor its one thread are to stay with a run."""
    try:
        command = module_command("cleargs.bench.pace")
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=PATIENCE_S)
        return _sound(json.loads(done.stdout))
    except (OSError, ValueError, TypeError, subprocess.SubprocessError):
        return None


def _sound(milliseconds: float) -> float:
    if not 0.0 < milliseconds < math.inf:
        raise ValueError("no time takes so long")
    return milliseconds


def _measure() -> float:
    """Milliseconds of processor time of the fastest iteration.

    Of the processor, and the fastest, since other work on the machine only ever adds to it. The first
    compiles the kernels, and is never the fastest.
    """
    from cleargs.bench.iteration import Iteration, use_threads
    from cleargs.bench.random_scenes import random_scene
    from cleargs.bench.timing import Clock

    use_threads(1)
    iteration, clock = Iteration(*random_scene(SPLATS, WIDTH, HEIGHT)), Clock()
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        iteration.run(clock)
        times.append(time.process_time() - start)
    return round(1e3 * min(times), 2)


if __name__ == "__main__":
    print(json.dumps(_measure()))
