"""What became of stages, or would become of them, on stdout."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from cleargs.cli.common import print_json
from cleargs.pipeline.plan import StagePlan, cost_line
from cleargs.pipeline.runner import Outcome
from cleargs.text import printable

DONE_IN_PART = 3


def exit_code(outcomes: Sequence[Outcome]) -> int:
    """0, or 3 where something is missing."""
    return DONE_IN_PART if any(outcome.manifest.status == "partial" for outcome in outcomes) else 0


def print_outcomes(outcomes: Sequence[Outcome], run: Path) -> None:
    """One line a stage, then what is missing (on stderr) or where the results are."""
    for outcome in outcomes:
        manifest = outcome.manifest
        how = f"made in {_duration(manifest.seconds)}" if outcome.how == "made" else "already there"
        partial = ", in part" if manifest.status == "partial" else ""
        click.echo(f"{outcome.stage:<12} {how}{partial}")
    last = outcomes[-1].manifest
    for missing in (*last.inherited, *(f"{last.stage}: {line}" for line in last.missing)):
        click.echo(f"missing: {printable(missing)}", err=True)
    if last.status == "partial":
        click.echo("hint: the same command tries again; --allow-partial goes on without", err=True)
    scene = "scene.ply" in last.files
    click.echo(f"{'scene' if scene else 'results'}: {run / last.stage / ('scene.ply' if scene else '')}")
    for outcome in outcomes:
        for name in outcome.manifest.files:
            if name.endswith(".parquet"):
                click.echo(f"table: {run / outcome.stage / name}")
    click.echo(f"look at them with: cleargs show {run}")


def outcome_json(outcome: Outcome) -> dict[str, Any]:
    """One outcome as JSON values."""
    manifest = outcome.manifest
    return {
        "stage": outcome.stage,
        "how": outcome.how,
        "status": manifest.status,
        "missing": [*manifest.inherited, *manifest.missing],
        "key": manifest.key,
        "digest": manifest.digest,
        "seconds": manifest.seconds,
        "folder": str(outcome.folder),
        "summary": manifest.summary,
    }


def print_plans(plans: list[StagePlan], as_json: bool) -> None:
    """The state of each stage and its reasons; then the expected cost."""
    if as_json:
        print_json([_plan_json(plan) for plan in plans])
        return
    for plan in plans:
        first, *others = plan.reasons or ("",)
        click.echo(f"{plan.stage:<12} {plan.state:<8} {first}".rstrip())
        for reason in others:
            click.echo(f"{'':<12} {'':<8} {reason}")
    line = cost_line(plans)
    if line:
        click.echo(line)


def _plan_json(plan: StagePlan) -> dict[str, Any]:
    cost = plan.estimate
    return {
        "stage": plan.stage,
        "state": plan.state,
        "key": plan.key,
        "reasons": list(plan.reasons),
        "estimate": None
        if cost is None
        else {"minutes": cost.minutes, "memory_gb": cost.memory_gb, "disk_gb": cost.disk_gb},
    }


def _duration(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 120 else f"{seconds / 60:.1f} min"
