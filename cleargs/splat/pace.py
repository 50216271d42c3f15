"""How fast this machine is beside the one on which the costs of the stages were measured.

``python -m cleargs.splat.pace`` prints the milliseconds that a training iteration takes here, on one thread.
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
"""Raised with whatever changes the milliseconds on one and the same machine: others are not read then."""

SPLATS, WIDTH, HEIGHT = 50_000, 640, 360
REPEATS = 12

REFERENCE_MS = 80.0
"""Of an iteration on the reference machine: a core of an Intel Xeon (Emerald Rapids, AVX-512)."""

TIMEOUT_S = 300
"""Two seconds of work; where no kernel is compiled yet, half a minute and more."""


def machine_pace(say: Callable[[str], None] | None = None) -> float:
    """This machine's time over that of the reference machine; 1 where nothing is known of it.

    Remembered from an earlier measurement. Without one it is measured where somebody is told so (``say``).
    """
    pace = cached_pace()
    if pace is not None or say is None:
        return 1.0 if pace is None else pace
    say("measuring the pace of this machine (once; kernels may have to be compiled for it)")
    milliseconds = _measured()
    if milliseconds is None:
        return 1.0
    with suppress(StoreError):
        write_json(_note(), {"milliseconds": milliseconds})
    return milliseconds / REFERENCE_MS


def cached_pace() -> float | None:
    """What was measured on this machine before; None where nothing was, or the note of it is damaged."""
    with suppress(*FAULTS):
        return _sound(read_json(_note())["milliseconds"]) / REFERENCE_MS
    return None


def processor_name() -> str:
    """Return the model of the first core as Linux names it, elsewhere the architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def random_scene(
    count: int, width: int, height: int, *, sigma: float = 1.8, seed: int = 0
) -> tuple[Gaussians, Camera]:
    """Return ``count`` random splats of SH degree 3, evenly over the view of a camera at the origin.

    ``sigma`` is the median standard deviation of a projected splat in px. Opacities are in [0.05, 0.95],
    depths in [2, 10]. Equal arguments give equal splats.
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


def _note() -> Path:
    """A file for each machine (a cluster's machines share their home), and for each version of the probe."""
    machine = {"host": platform.node(), "processor": processor_name(), "probe": PROBE}
    name = hashlib.sha256(json.dumps(machine, sort_keys=True).encode()).hexdigest()[:16]
    return cache_folder("pace") / f"{name}.json"


def _measured() -> float | None:
    """In a process of its own: neither its memory nor its one thread are to stay with a run."""
    try:
        command = module_command("cleargs.splat.pace")
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=TIMEOUT_S)
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
