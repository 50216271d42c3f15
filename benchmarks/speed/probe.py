"""Time each kernel inside a call, without changes to the kernels."""

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
"""Kernels of a training iteration (module.function in `PACKAGE`), in the order of their calls."""


@contextmanager
def timed_kernels(clock: Clock) -> Iterator[None]:
    """Within the block, add the time of each kernel to the part of ``clock`` with its name.

    Callers look kernels up in their modules, so timed versions replace them there. This costs about a
    microsecond per call.
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
