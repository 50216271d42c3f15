"""Peak memory of training at one size, measured in a separate process.

``python -m benchmarks.speed.peak_memory COUNT WIDTH HEIGHT SIGMA`` prints the peak bytes of a scene and three
iterations, without the loaded program. It prints ``null`` if the system does not report memory.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

from cleargs.subprocesses import module_command

STATUS = Path("/proc/self/status")
RESET = Path("/proc/self/clear_refs")
ITERATIONS = 3


def peak_memory(count: int, width: int, height: int, sigma: float) -> int | None:
    """Return the peak bytes of parameters, moments, gradients and buffers; None if unknown."""
    command = module_command("benchmarks.speed.peak_memory", str(count), str(width), str(height), str(sigma))
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}  # the checkout
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    value: int | None = json.loads(done.stdout)
    return value


def _resident(field: str) -> int:
    found = re.search(rf"^{field}:\s+(\d+) kB", STATUS.read_text(), re.MULTILINE)
    if found is None:
        raise OSError(f"{STATUS} has no {field}")
    return 1024 * int(found[1])


def _measure(count: int, width: int, height: int, sigma: float) -> int | None:
    from benchmarks.speed.iteration import Iteration
    from benchmarks.speed.timing import Clock
    from cleargs.splat.kernels.cpu.backend import warm_up
    from cleargs.splat.random_scene import random_scene

    warm_up()
    try:
        before = _resident("VmRSS")
        scene = random_scene(count, width, height, sigma=sigma)
        RESET.write_text("5")  # resets the peak: making the scene needs float64 copies
        iteration = Iteration(*scene)
        for _ in range(ITERATIONS):
            iteration.run(Clock())
        return _resident("VmHWM") - before
    except OSError:
        return None


if __name__ == "__main__":
    count, width, height = map(int, sys.argv[1:4])
    print(json.dumps(_measure(count, width, height, float(sys.argv[4]))))
