"""The usage of a stage counts from its start and includes child processes."""

from __future__ import annotations

import subprocess
import sys
import time

from cleargs.pipeline.runner import Usage

WORK = "import time\nwhile time.process_time() < 0.3: pass"


def test_processor_time_of_this_process_and_of_children() -> None:
    usage = Usage()
    start = time.process_time()
    while time.process_time() - start < 0.2:
        pass
    own = usage.cpu_seconds
    assert own >= 0.19  # the clocks of the two differ by a tick
    subprocess.run([sys.executable, "-c", WORK], check=True)
    assert usage.cpu_seconds - own >= 0.29


HELD = """
from cleargs.pipeline.runner import Usage
usage = Usage()
before = usage.peak_memory_gb
block = bytearray(200_000_000)
block[::4096] = b"x" * len(block[::4096])  # touched, so resident
assert usage.peak_memory_gb - before > 0.15
"""


def test_allocated_memory_counts() -> None:
    """Use a separate process: in this one, memory of other tests may be freed in the meantime."""
    subprocess.run([sys.executable, "-c", HELD], check=True)
