"""Pace of this machine: its time for a training iteration, relative to the reference machine.

``python -m cleargs.splat.pace`` prints the milliseconds of processor time that an iteration takes on one
thread. `REFERENCE_MS` is the output on the reference machine. The constants of the stages' ``estimate`` were
measured on the same machine. Measure all of them together (docs/experiments/speed.md).
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
from typing import TYPE_CHECKING

from cleargs.errors import StoreError
from cleargs.files import write_json
from cleargs.kernel_cache import cache_folder
from cleargs.safe_io import FAULTS, read_json
from cleargs.subprocesses import module_command

if TYPE_CHECKING:
    from cleargs.splat.camera import Camera
    from cleargs.splat.gaussians import Gaussians

PROBE = 1
"""Version of the measurement. Increment it with each change that affects the time on the same machine."""

SPLATS, WIDTH, HEIGHT = 50_000, 640, 360
REPEATS = 12

REFERENCE_MS = 80.0
"""Time of an iteration on the reference machine: one core of an Intel Xeon (Emerald Rapids, AVX-512)."""

TIMEOUT_S = 300
"""Time limit of a measurement. It takes a few seconds."""


def machine_pace(say: Callable[[str], None] | None = None) -> float:
    """Return the pace of this machine, greater than 1 for slower machines; 1 if it is unknown.

    The pace is read from a cache, or measured if ``say`` is given; ``say`` then receives a message first.
    It cannot be measured before the kernels are compiled (`cleargs.splat.compilation`).
    """
    from cleargs.splat.kernels.cpu.jit import is_compiled  # loads Numba

    pace = cached_pace()
    if pace is not None or say is None or not is_compiled("cpu"):
        return 1.0 if pace is None else pace
    say("measuring the speed of this machine, once")
    milliseconds = _measure_in_subprocess()
    if milliseconds is None:
        return 1.0
    with suppress(StoreError):
        write_json(_cache_file(), {"milliseconds": milliseconds})
    return milliseconds / REFERENCE_MS


def cached_pace() -> float | None:
    """Return the pace that was measured earlier on this machine, or None."""
    with suppress(*FAULTS):
        return _checked(read_json(_cache_file())["milliseconds"]) / REFERENCE_MS
    return None


def processor_name() -> str:
    """Return the model name of the processor on Linux, or the architecture on other systems."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def random_scene(
    count: int, width: int, height: int, *, sigma: float = 1.8, seed: int = 0
) -> tuple[Gaussians, Camera]:
    """Return random Gaussians of SH degree 3 in the view of a camera at the origin, and the camera.

    The density in the image of ``width`` x ``height`` px is uniform. Opacities are in [0.05, 0.95], depths in
    [2, 10]. ``sigma`` is the median standard deviation of a projected splat, px. Equal arguments give equal
    Gaussians.
    """
    import numpy as np
    import torch

    from cleargs.splat.camera import Camera
    from cleargs.splat.gaussians import Gaussians

    rng = np.random.default_rng(seed)
    focal = 0.87 * width
    z = rng.uniform(2.0, 10.0, count)
    u, v = (side * rng.uniform(-0.03, 1.03, count) for side in (width, height))
    means = np.stack([(u - width / 2) / focal * z, (v - height / 2) / focal * z, z], 1)
    deviations = sigma * np.exp(rng.normal(0, 0.5, count)) * z / focal
    scales = deviations[:, None] * np.exp(rng.normal(0, 0.5, (count, 3)))
    opacities = rng.uniform(0.05, 0.95, count)
    sh = rng.normal(0, 0.15, (count, 16, 3))
    sh[:, 0] = rng.normal(0, 1, (count, 3))
    rotations = rng.normal(size=(count, 4))
    parameters = (means, np.log(scales), rotations, np.log(opacities / (1 - opacities)), sh)
    tensors = (torch.from_numpy(array.astype(np.float32)) for array in parameters)
    return Gaussians(*tensors), Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def _cache_file() -> Path:
    """Return the cache file of this machine and `PROBE`. Machines of a cluster share a home folder."""
    machine = {"host": platform.node(), "processor": processor_name(), "probe": PROBE}
    name = hashlib.sha256(json.dumps(machine, sort_keys=True).encode()).hexdigest()[:16]
    return cache_folder("pace") / f"{name}.json"


def _measure_in_subprocess() -> float | None:
    """Measure in a subprocess, so that its memory and its thread settings do not affect a run."""
    try:
        command = module_command("cleargs.splat.pace")
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=TIMEOUT_S)
        return _checked(json.loads(done.stdout))
    except (OSError, ValueError, TypeError, subprocess.SubprocessError):
        return None


def _checked(milliseconds: float) -> float:
    if not 0.0 < milliseconds < math.inf:
        raise ValueError(f"{milliseconds} is not a valid time")
    return milliseconds


def _measure() -> float:
    """Return the processor time of the fastest iteration in milliseconds.

    Other work on the machine can only increase a time. The first iteration compiles the kernels.
    """
    import torch

    from cleargs.splat.backend import LossAccumulator, rasteriser_for, set_threads, step_gaussians
    from cleargs.splat.types import Moments

    set_threads(1)
    torch.set_num_threads(1)
    gaussians, camera = random_scene(SPLATS, WIDTH, HEIGHT)
    target = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    slope = torch.empty_like(target)
    engine, losses, moments = rasteriser_for(), LossAccumulator("cpu", 0.2), Moments.zeros(gaussians)
    rates: dict[str, float | torch.Tensor] = dict.fromkeys(gaussians.tensors(), 0.0)
    times = []
    for step in range(1, REPEATS + 1):
        start = time.process_time()
        image = engine.forward(gaussians, camera).image
        losses.add(step, image, target, gradient=slope)
        step_gaussians(gaussians, engine.backward(slope), moments, rates, step=step)
        times.append(time.process_time() - start)
    return round(1e3 * min(times), 2)


if __name__ == "__main__":
    print(json.dumps(_measure()))
