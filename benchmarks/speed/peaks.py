"""Measure the peaks of the machine: multiply-adds and copied bytes per second."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numba import prange

from benchmarks.speed.iteration import use_threads
from cleargs.splat.kernels.cpu.jit import kernel
from cleargs.splat.kernels.cpu.simd import LANES, broadcast, load, store
from cleargs.types import ArrayF32

CHAINS = 12
"""Independent chains of multiply-adds: enough to fill two pipes with a latency of four to five cycles."""
FMA_STEPS = 500_000
"""Steps per repeat: about a millisecond, so that some repeats run undisturbed on a busy machine."""
COPY_BYTES = 256 << 20
"""Size of the copied arrays: many times a last-level cache."""
SLICES = 32
"""Parts of the arrays. Each repeat copies the next part, so a part has left the cache when its turn comes."""
BLOCKS = 64
"""Units of work of the parallel copy."""
HALF = np.float32(0.5)


@dataclass(frozen=True)
class Peaks:
    """Best values of all repeats; a multiply-add counts as two operations, a copied byte as two bytes."""

    gflops: float  # 1e9 float32 operations per second in the kernels' vectors
    gbytes: float  # 1e9 bytes per second, read and written


@kernel
def multiply_add(workers: int, steps: int, factor: np.float32, addend: np.float32, values: ArrayF32) -> None:
    """Run `CHAINS` independent chains x = x m + c of `LANES` lanes on each worker."""
    for worker in prange(workers):
        start = worker * CHAINS * LANES
        # Values must be unknown to the compiler: it would merge equal chains and fold known factors.
        m, c = broadcast(factor), broadcast(addend)
        x0 = load(values, start + 0 * LANES)
        x1 = load(values, start + 1 * LANES)
        x2 = load(values, start + 2 * LANES)
        x3 = load(values, start + 3 * LANES)
        x4 = load(values, start + 4 * LANES)
        x5 = load(values, start + 5 * LANES)
        x6 = load(values, start + 6 * LANES)
        x7 = load(values, start + 7 * LANES)
        x8 = load(values, start + 8 * LANES)
        x9 = load(values, start + 9 * LANES)
        x10 = load(values, start + 10 * LANES)
        x11 = load(values, start + 11 * LANES)
        for _ in range(steps):
            x0 = x0 * m + c
            x1 = x1 * m + c
            x2 = x2 * m + c
            x3 = x3 * m + c
            x4 = x4 * m + c
            x5 = x5 * m + c
            x6 = x6 * m + c
            x7 = x7 * m + c
            x8 = x8 * m + c
            x9 = x9 * m + c
            x10 = x10 * m + c
            x11 = x11 * m + c
        store(values, start + 0 * LANES, x0)
        store(values, start + 1 * LANES, x1)
        store(values, start + 2 * LANES, x2)
        store(values, start + 3 * LANES, x3)
        store(values, start + 4 * LANES, x4)
        store(values, start + 5 * LANES, x5)
        store(values, start + 6 * LANES, x6)
        store(values, start + 7 * LANES, x7)
        store(values, start + 8 * LANES, x8)
        store(values, start + 9 * LANES, x9)
        store(values, start + 10 * LANES, x10)
        store(values, start + 11 * LANES, x11)


@kernel
def copy(source: ArrayF32, target: ArrayF32) -> None:
    """Copy ``source`` [n] to ``target`` [n]."""
    n = source.shape[0]
    for block in prange(BLOCKS):
        begin, end = n * block // BLOCKS, n * (block + 1) // BLOCKS
        target[begin:end] = source[begin:end]


def measure_peaks(
    threads: int, repeats: int, *, steps: int = FMA_STEPS, copy_bytes: int = COPY_BYTES
) -> Peaks:
    """Measure the peaks on ``threads`` threads: the best of ``repeats``, after a warm-up."""
    use_threads(threads)
    values = np.linspace(0.1, 0.9, threads * CHAINS * LANES, dtype=np.float32)
    source = np.ones(copy_bytes // 4, np.float32)
    target = np.zeros_like(source)
    multiply_add(threads, steps, HALF, HALF, values)
    copy(source, target)
    length = len(source) // SLICES
    flops, gbytes = 0.0, 0.0
    for repeat in range(repeats):
        start = time.perf_counter()
        multiply_add(threads, steps, HALF, HALF, values)
        flops = max(flops, 2 * CHAINS * LANES * steps * threads / (time.perf_counter() - start))
        part = slice(repeat % SLICES * length, (repeat % SLICES + 1) * length)
        start = time.perf_counter()
        copy(source[part], target[part])
        gbytes = max(gbytes, 8 * length / (time.perf_counter() - start))
    return Peaks(flops / 1e9, gbytes / 1e9)
