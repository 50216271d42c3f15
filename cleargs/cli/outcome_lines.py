"""The last lines of ``cleargs run``: the result, its quality, its time and the next command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

import click

from cleargs.cli.commands import as_called
from cleargs.pipeline.run_file import SCENE
from cleargs.pipeline.runner import StageOutcome
from cleargs.report.formatting import duration
from cleargs.safe_io import printable

Summaries = Mapping[str, Mapping[str, Any]]
"""Stage -> figures in its manifest."""


def print_lines(outcomes: Sequence[StageOutcome], lines: Sequence[str]) -> None:
    """Print missing outputs on stderr, then the ``lines`` of `outcome_lines` on stdout."""
    last = outcomes[-1].manifest
    for missing in (*last.inherited, *(f"{last.stage}: {line}" for line in last.missing)):
        click.echo(f"missing: {printable(missing)}", err=True)
    if last.status == "partial":
        click.echo(
            "hint: give the same command again to retry, or --allow-partial to go on without it", err=True
        )
    for line in lines:
        click.echo(line)


def outcome_lines(outcomes: Sequence[StageOutcome], run: Path, report: Path | None = None) -> list[str]:
    """Return at most five lines: the result, its quality, the time, the next command, and the ``report``.

    The line of the report is a URL, which most terminals open on a click.
    """
    last = outcomes[-1].manifest
    summaries = {outcome.stage: outcome.manifest.summary for outcome in outcomes}
    scene = SCENE in last.files
    doubted = any(outcome.stage == "ingest" and outcome.manifest.missing for outcome in outcomes)
    partial = ", in part" if last.status == "partial" else ""
    place = run / (SCENE if scene else last.stage)
    lines = [
        f"{'scene' if scene else 'results'}: {place}{partial}{_extent(summaries, doubted)}",
        f"quality: {_quality(summaries)}",
        f"time: {_times(outcomes)}",
        as_called(f"next: {_next(summaries, run, scene)}"),
        f"report: {report.as_uri() if report else ''}",
    ]
    return [line for line in lines if not line.endswith(": ")]


def _trust(kept_out: Mapping[str, Any] | None, doubted: bool) -> str:
    """Return if frames count as placed, with the figure of the keypoints that took no part in their fit.

    ``doubted``: ingest says that the images contradict the cameras.
    """
    if kept_out is None:
        return "placed"
    figure = (
        f"{kept_out['share']:.0%} of kept-out keypoints within 2 px, median {kept_out['median_px']:.2g} px"
    )
    from cleargs.capture.sfm_job import GOOD_SHARE

    doubted |= kept_out["share"] < GOOD_SHARE
    return f"{'with doubtful cameras' if doubted else 'placed'}: {figure}"


def _extent(summaries: Summaries, doubted: bool) -> str:
    """Return the numbers of placed, reliable and repaired frames, as far as they are known."""
    ingest, consolidate = summaries.get("ingest", {}), summaries.get("consolidate", {})
    words = []
    if "registered" in ingest and "frames" in ingest:
        trust = _trust(ingest.get("kept_out"), doubted)
        words.append(f"{ingest['registered']} of {ingest['frames']} frames {trust}")
    if "roles" in summaries.get("rva", {}):
        words.append(f"{summaries['rva']['roles']['strong']} reliable")
    if consolidate.get("repairs"):
        words.append(f"{consolidate['repairs']} repaired")
    return f" ({', '.join(words)})" if words else ""


def _quality(summaries: Summaries) -> str:
    """Return the quality of the last scene; "" if it is unknown."""
    scenes = {
        stage: figures for stage, figures in summaries.items() if figures.get("psnr_unseen") is not None
    }
    if not scenes:
        return ""
    last, figures = list(scenes.items())[-1]
    first = summaries.get("g0", {}).get("psnr_unseen")
    compared = f" (first scene {first:.1f})" if last != "g0" and first is not None else ""
    text = (
        f"PSNR {figures['psnr_unseen']:.1f} dB{compared} on pixels that no training saw; "
        "views off the camera path are worse"
    )
    harm = figures.get("control", {}).get("harm")
    return f"{text}. Rejected: {harm}" if harm else text


def _times(outcomes: Sequence[StageOutcome]) -> str:
    """Return the time that this call took per stage, and the stages whose results it found."""
    made = [outcome for outcome in outcomes if outcome.how == "made"]
    found = [outcome.stage for outcome in outcomes if outcome.how == "found"]
    words = []
    if made:
        stages = ", ".join(f"{outcome.stage} {duration(outcome.manifest.seconds)}" for outcome in made)
        words.append(f"{duration(sum(outcome.manifest.seconds for outcome in made))} ({stages})")
        if (compiling := sum(outcome.manifest.compile_seconds for outcome in made)) >= 1.0:
            words.append(f"{duration(compiling)} for compiling kernels, once on this machine")
    if found:
        words.append(f"reused: {', '.join(found)}")
    return "; ".join(words)


def _next(summaries: Summaries, run: Path, scene: bool) -> str:
    if not scene:
        stage = " rva" if list(summaries)[-1] == "rva" else ""
        return f"cleargs show {quote(str(run))}{stage}"
    if summaries.get("ingest", {}).get("test"):
        return f"cleargs eval {quote(str(run))}"
    return f"cleargs export {quote(str(run))} -o {quote(f'{run.absolute().name}.sog')}"
