"""What became of stages, or would become of them, on stdout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

import click

from cleargs.cli.common import print_json
from cleargs.pipeline.plan import StagePlan, cost_line
from cleargs.pipeline.runner import Outcome
from cleargs.untrusted import printable

DONE_IN_PART = 3

Summaries = Mapping[str, Mapping[str, Any]]
"""Stage -> the figures of its manifest."""


def exit_code(outcomes: Sequence[Outcome]) -> int:
    """0, or 3 where something is missing."""
    return DONE_IN_PART if any(outcome.manifest.status == "partial" for outcome in outcomes) else 0


PICTURES = ("before_after.png", "candidates.png")
"""What to look at, the first that a stage has."""


def print_outcomes(outcomes: Sequence[Outcome], run: Path, report: Path | None = None) -> None:
    """What is missing (on stderr); then at most five lines: what was made, how good it is, how long it took,
    what to look at (the ``report``, a picture), the next command."""
    last = outcomes[-1].manifest
    for missing in (*last.inherited, *(f"{last.stage}: {line}" for line in last.missing)):
        click.echo(f"missing: {printable(missing)}", err=True)
    if last.status == "partial":
        click.echo("hint: the same command tries again; --allow-partial continues without it", err=True)
    summaries = {outcome.stage: outcome.manifest.summary for outcome in outcomes}
    scene = "scene.ply" in last.files
    partial = ", in part" if last.status == "partial" else ""
    place = run / last.stage / ("scene.ply" if scene else "")
    click.echo(f"{'scene' if scene else 'results'}: {place}{partial}{_extent(summaries)}")
    if quality := _quality(summaries):
        click.echo(f"quality: {quality}")
    click.echo(f"time: {_times(outcomes)}")
    pictures = [
        run / outcome.stage / name
        for outcome in reversed(outcomes)
        for name in PICTURES
        if name in outcome.manifest.files
    ]
    if shown := [*([report] if report else []), *pictures[:1]]:
        click.echo(f"look at: {', '.join(map(str, shown))}")
    click.echo(f"next: {_next(summaries, run, scene)}")


def _extent(summaries: Summaries) -> str:
    """How large the result is: frames with a pose, and how many of them were repaired."""
    ingest, consolidate = summaries.get("ingest", {}), summaries.get("consolidate", {})
    words = []
    if "registered" in ingest and "frames" in ingest:
        words.append(f"{ingest['registered']} of {ingest['frames']} frames placed")
    if "roles" in summaries.get("rva", {}):
        words.append(f"{summaries['rva']['roles']['strong']} strong")
    if "repairs" in consolidate:
        words.append(f"{consolidate['repairs']} repaired")
    return f" ({', '.join(words)})" if words else ""


def _quality(summaries: Summaries) -> str:
    """What is known of how good the last scene is; "" for nothing."""
    scenes = {
        stage: figures for stage, figures in summaries.items() if figures.get("psnr_unseen") is not None
    }
    if not scenes:
        return ""
    last, figures = list(scenes.items())[-1]
    first = summaries.get("g0", {}).get("psnr_unseen")  # `cleargs stage` tells of one stage alone
    beside = f" (first scene {first:.1f})" if last != "g0" and first is not None else ""
    text = (
        f"PSNR {figures['psnr_unseen']:.1f} dB{beside} on pixels that no training saw; "
        "views off the path are worse"
    )
    harm = figures.get("held_back", {}).get("harm")
    return f"{text}. Rejected: {harm}" if harm else text


def _times(outcomes: Sequence[Outcome]) -> str:
    """How long this call worked, stage by stage, and what it found."""
    made = [outcome for outcome in outcomes if outcome.how == "made"]
    found = [outcome.stage for outcome in outcomes if outcome.how == "found"]
    words = []
    if made:
        stages = ", ".join(f"{outcome.stage} {duration(outcome.manifest.seconds)}" for outcome in made)
        words.append(f"{duration(sum(outcome.manifest.seconds for outcome in made))} ({stages})")
    if found:
        words.append(f"already there: {', '.join(found)}")
    return "; ".join(words)


def _next(summaries: Summaries, run: Path, scene: bool) -> str:
    """The command to give next."""
    if not scene:
        stage = " rva" if list(summaries)[-1] == "rva" else ""
        return f"cleargs show {quote(str(run))}{stage}"
    if summaries.get("ingest", {}).get("test"):
        return f"cleargs eval {quote(str(run))}"
    return f"cleargs export {quote(str(run))} -o {quote(f'{run.name}.ply')}"


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
            click.echo(f"{'':<21} {reason}")
    if line := cost_line(plans):
        click.echo(line)


def duration(seconds: float) -> str:
    """Seconds, or minutes where there are many."""
    return f"{seconds:.1f} s" if seconds < 120 else f"{seconds / 60:.1f} min"


def _plan_json(plan: StagePlan) -> dict[str, Any]:
    figures = ("minutes", "memory_gb", "disk_gb")
    estimate = plan.estimate and {name: getattr(plan.estimate, name) for name in figures}
    facts = {"stage": plan.stage, "state": plan.state, "key": plan.key, "reasons": list(plan.reasons)}
    return {**facts, "estimate": estimate}
