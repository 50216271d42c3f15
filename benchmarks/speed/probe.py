"""Times of the single kernels inside a call, without the kernels knowing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Any
from unittest.mock import patch

from benchmarks.speed.timing import Clock

PACKAGE = "cleargs.splat.kernels.cpu"

KERNELS = (
    "projection.project",
    "binning.pair_ranges",
    "binning.depth_order",
    "binning.list_pairs",
    "binning.sort_pairs_by_tile",
    "rasterise.forward",
    "loss.pad_images",
    "loss.measure",
    "loss.differentiate",
    "rasterise.backward",
    "gradients.backpropagate",
    "elementwise.adam",
)
"""Entry points of a training iteration (module.function below PACKAGE), in the order of their work."""


@contextmanager
def timed_kernels(clock: Clock) -> Iterator[None]:
    """Within the block every kernel's time is added to the part of ``clock`` that bears its name.

    Callers look kernels up in their modules, so they are replaced there. Costs about a microsecond a call.
    """
    with ExitStack() as replaced:
        for name in KERNELS:
            module_name, function = name.split(".")
            module = import_module(f"{PACKAGE}.{module_name}")
            timed = _timed(getattr(module, function), name, clock)
            replaced.enter_context(patch.object(module, function, timed))
        yield


def _timed(kernel: Callable[..., Any], name: str, clock: Clock) -> Callable[..., Any]:
    def run(*arguments: Any) -> Any:
        start = time.perf_counter()
        result = kernel(*arguments)
        clock.add(name, 1e3 * (time.perf_counter() - start))
        return result

    return run
