"""Time and quality of each ``--quality``: whole runs on real captures, evaluated on held-out frames."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.comparison.scenes import capture_name
from benchmarks.speed.benchmark_results import Machine, describe_machine
from cleargs.api import evaluate_scene
from cleargs.api import run as run_capture
from cleargs.errors import InputError
from cleargs.evaluate.config import EvalOptions
from cleargs.pipeline.stages import installed
from cleargs.progress import Reporter
from cleargs.splat.config import Quality

HOLDOUT = "every:8"
"""Every eighth frame, as in the literature (3D Gaussian Splatting, Mip-NeRF 360)."""


@dataclass(frozen=True)
class QualityPlan:
    """Runs of the benchmark."""

    captures: tuple[Path, ...]
    qualities: tuple[Quality, ...]
    settings: Mapping[str, Any]
    """Changes to the recipe, by name; ``ingest.holdout`` is `HOLDOUT` by default."""
    until: str
    """Last stage; its scene is evaluated."""
    threads: int


@dataclass(frozen=True)
class QualityRow:
    """Results of one capture at one quality."""

    capture: str
    quality: Quality
    seconds: Mapping[str, float]
    """Stage -> wall seconds. A stage that qualities share runs once and counts for each."""
    cpu_seconds: float | None
    """Processor time of all stages; None if it is unknown for one."""
    peak_memory_gb: float | None
    steps: int
    gaussians: int
    images: int
    """Number of held-out frames."""
    means: Mapping[str, float | None]
    """Metric -> mean over the held-out frames."""


@dataclass(frozen=True)
class QualityBenchmark:
    """Results by capture and quality, and the machine."""

    machine: Machine
    plan: QualityPlan
    rows: list[QualityRow]

    def as_json(self) -> dict[str, Any]:
        """Return dictionaries and lists; captures are given by name."""
        plan = {
            "qualities": self.plan.qualities,
            "settings": dict(self.plan.settings),
            "until": self.plan.until,
            "threads": self.plan.threads,
        }
        return {
            "machine": asdict(self.machine),
            "plan": plan,
            "rows": [{**asdict(row), "total": sum(row.seconds.values())} for row in self.rows],
        }


def run(plan: QualityPlan, folder: Path, reporter: Reporter) -> QualityBenchmark:
    """Run each capture of ``plan`` at each quality in ``folder``; finished runs are reused.

    Raises:
        InputError: Two captures have the same name.
        CleargsError: A run failed.
    """
    names = [capture_name(capture) for capture in plan.captures]
    if len(set(names)) < len(names):
        raise InputError("two captures have the same name", hint="rename one, or measure them separately")
    load = os.getloadavg()[0]
    rows = [
        _row(capture, quality, plan, folder, reporter)
        for capture in plan.captures
        for quality in plan.qualities
    ]
    return QualityBenchmark(describe_machine(load), plan, rows)


def _row(capture: Path, quality: Quality, plan: QualityPlan, folder: Path, reporter: Reporter) -> QualityRow:
    reporter.info(f"{capture_name(capture)}, {quality}")
    done = run_capture(
        capture,
        folder / f"{capture_name(capture)}-{quality}",
        recipe="default",  # replaces the settings of an earlier call
        quality=quality,
        set={"ingest.holdout": HOLDOUT, **plan.settings},
        until=plan.until,
        store=folder / "store",
        threads=plan.threads,
        progress=reporter,
    )
    options = EvalOptions(lpips=("alex",), scorers=())
    found = evaluate_scene(done, stage=plan.until, options=options, threads=plan.threads, progress=reporter)
    stages = installed().until(plan.until)  # an earlier call may have run later stages too
    manifests = [done[stage].manifest for stage in stages]
    logs = [done[m.stage].table("train") for m in manifests if "train.parquet" in m.files]
    return QualityRow(
        capture_name(capture),
        quality,
        seconds={m.stage: m.seconds for m in manifests},
        cpu_seconds=_sum([m.cpu_seconds for m in manifests]),
        peak_memory_gb=max((m.peak_memory_gb for m in manifests if m.peak_memory_gb), default=None),
        steps=sum(log.num_rows for log in logs),
        gaussians=done.scene(plan.until).gaussians.num,
        images=len(found.images),
        means=found.means,
    )


def _sum(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) if len(known) == len(values) else None
