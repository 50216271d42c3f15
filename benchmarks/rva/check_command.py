"""``rva check``: correlation of cues with the known degradations of synthetic captures."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cleargs.cli.common import json_option, print_json
from cleargs.errors import InputError
from cleargs.manifest import linked_manifest
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.stages import Stages

if TYPE_CHECKING:
    from benchmarks.rva.truth import Check

TRUTH = Path("truth", "frames.parquet")
"""File of `cleargs synth` with the true degradations of each frame."""

_HEADS = ("frames", "strong", "B ~ blur", "-R ~ blur", "motion ~ blur", "defocus ~ disc", "exposure ~ stops")


@click.command(
    epilog="""\b
Examples:
  cleargs synth data/mixed --protocol mixed
  cleargs run data/mixed -o runs/mixed --until rva
  python -m benchmarks rva check runs/mixed
  python -m benchmarks rva check runs/* --json
"""
)
@click.argument(
    "runs",
    metavar="RUN...",
    nargs=-1,
    required=True,
    type=click.Path(exists=True, file_okay=False, path_type=Path),
)
@json_option
@click.pass_obj
def check(dag: Stages, runs: tuple[Path, ...], as_json: bool) -> None:
    """Correlate the cues of each RUN with the known degradations of its synthetic capture.

    The table shows Spearman's rank correlation. Blur under 1 px and exposure errors under a quarter of a
    stop count as zero. B and R are compared with the blur length over the frames without another
    degradation.
    """
    found = {str(run): _check(run, dag) for run in runs}
    if as_json:
        print_json({run: asdict(result) for run, result in found.items()})
        return
    width = max(map(len, found))
    click.echo("  ".join([" " * width, *_HEADS]))
    for run, result in found.items():
        values = [str(result.frames), f"{100 * result.strong:.0f} %"]
        values += ["-" if value is None else f"{value:.2f}" for value in list(asdict(result).values())[2:]]
        cells = [value.rjust(len(head)) for value, head in zip(values, _HEADS, strict=True)]
        click.echo("  ".join([run.ljust(width), *cells]))


def _check(run: Path, dag: Stages) -> Check:
    """Compare the run's cues with the truth; raise InputError if either is missing."""
    import numpy as np

    from benchmarks.rva.truth import Faults, check
    from cleargs.parquet import read_table
    from cleargs.rva.tables import B_CUES, FRAMES
    from cleargs.synth.synthetic_capture import FRAMES as TRUE_FRAMES
    from cleargs.types import ArrayF64

    source = read_run_file(run, dag).source
    if linked_manifest(run, "rva") is None:
        raise InputError(f"rva is not done in {run}", hint=f"first: cleargs stage rva {run}")
    if not (source / TRUTH).is_file():
        raise InputError(
            f"the capture {source} has no {TRUTH}", hint="give runs on captures made by `cleargs synth`"
        )
    rated = read_table((run / "rva").resolve() / "frames.parquet", FRAMES)
    true = read_table(source / TRUTH, TRUE_FRAMES)
    row = {Path(image).name: k for k, image in enumerate(true["image"].to_pylist())}
    names = [Path(name).name for name in rated["name"].to_pylist()]
    absent = [name for name in names if name not in row]
    if absent:
        raise InputError(
            f"{absent[0]} is not in {source / TRUTH}",
            hint="the capture changed: repeat the run, or rebuild the capture",
        )
    scored = np.flatnonzero(~np.isnan(np.asarray(rated["R"].to_numpy(), dtype=np.float64)))
    order = np.array([row[names[k]] for k in scored], dtype=np.intp)

    def column(name: str) -> ArrayF64:
        return np.asarray(rated[name].to_numpy(), dtype=np.float64)[scored]

    return check(
        column("R"),
        column("B"),
        {f"b_{name}": column(f"b_{name}") for name in B_CUES},
        np.asarray(rated["reliable"].to_numpy(), dtype=bool)[scored],
        Faults(*(true[name].to_numpy()[order] for name in ("blur_px", "defocus_px", "exposure_ev"))),
    )
