"""What a job asks the cluster for: the stage's own estimate with room above it, or what the sheet says."""

from __future__ import annotations

import math

from pydantic import Field

from cleargs.pipeline.run_file import Device
from cleargs.pipeline.stage import Estimate
from cleargs.record import Record

GPU_STAGES = ("rva", "g0", "rivr", "consolidate")
"""Stages that compute on the GPU where the run's device is one."""

TIME_ROOM, MIN_MINUTES = 3.0, 15
"""Estimates are rough and nodes differ; a job that still meets its limit resumes from its checkpoint."""
MEMORY_ROOM, MIN_MEMORY_GB = 1.5, 2.0
CPUS = 4


class Wanted(Record):
    """``[resources.STAGE]`` of a sheet: each field replaces what would follow from the estimate."""

    cpus: int | None = Field(None, ge=1, le=1024, description="CPU cores, also the number of threads")
    memory_gb: float | None = Field(None, gt=0, le=100_000, description="memory, GB (1000 MB)")
    minutes: int | None = Field(
        None, ge=1, le=525_600, description="run time limit, minutes (at most a year)"
    )
    gpus: int | None = Field(None, ge=0, le=64, description="GPUs")


class Resources(Record):
    """What one job asks for, in Snakemake's units."""

    threads: int
    mem_mb: int
    runtime: int
    """Minutes."""
    gpu: int


def resources(stage: str, estimate: Estimate | None, wanted: Wanted, device: Device) -> Resources:
    """What a job of ``stage`` asks for; without an ``estimate`` the least that any job gets."""
    minutes = 0.0 if estimate is None else TIME_ROOM * estimate.minutes
    memory_gb = 0.0 if estimate is None else MEMORY_ROOM * estimate.memory_gb
    gpus = 1 if device == "cuda" and stage in GPU_STAGES else 0
    return Resources(
        threads=wanted.cpus or CPUS,
        mem_mb=math.ceil(1000 * (wanted.memory_gb or max(MIN_MEMORY_GB, memory_gb))),
        runtime=wanted.minutes or max(MIN_MINUTES, math.ceil(minutes)),
        gpu=gpus if wanted.gpus is None else wanted.gpus,
    )
