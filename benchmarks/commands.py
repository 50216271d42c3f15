"""The commands of ``python -m benchmarks``."""

from __future__ import annotations

import click

from benchmarks.comparison.compare_command import compare
from benchmarks.comparison.evidence_command import evidence
from benchmarks.comparison.real_command import real
from benchmarks.comparison.world_command import world
from benchmarks.formats_command import formats
from benchmarks.motion_command import motion
from benchmarks.native_command import native
from benchmarks.poses_command import poses
from benchmarks.rva.agree_command import agree
from benchmarks.rva.check_command import check
from benchmarks.speed.commands import formation, quality, splat, train
from cleargs.cli import main as program
from cleargs.pipeline.stages import Stages


@click.group("python -m benchmarks", context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
def benchmarks(debug: bool) -> None:
    """Measure the speed and error of ClearGS, compare its variants and check its evaluators of frames."""


@benchmarks.group()
def rva() -> None:
    """Compare evaluators of frames and check them against ground truth."""


for command in (
    splat,
    train,
    formation,
    quality,
    compare,
    evidence,
    real,
    world,
    poses,
    motion,
    native,
    formats,
):
    benchmarks.add_command(command)
for command in (agree, check):
    rva.add_command(command)


def main() -> None:
    """Run the command line and exit."""
    program.main(program=benchmarks)


def invoke(arguments: list[str], dag: Stages | None = None) -> int:
    """Run one command and return its exit code. Tests give ``dag`` to replace the installed stages."""
    return program.invoke(arguments, dag, benchmarks)
