"""Options and output functions of several commands."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, get_args

import click

from cleargs.manifest import Manifest
from cleargs.pipeline.session import usable_cores
from cleargs.splat.config import Quality

F = TypeVar("F", bound=Callable[..., Any])

DONE_IN_PART = 3
"""Exit code of work that is done only in part."""

FOLDER = click.Path(file_okay=False, path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)

store_option = click.option(
    "--store",
    envvar="CLEARGS_STORE",
    show_envvar=True,
    type=FOLDER,
    help="Folder of the results, which several runs may share.  [default: RUN/.store]",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Print warnings and results only.")
partial_option = click.option(
    "--allow-partial", is_flag=True, help="Continue after a stage that is done only in part."
)
run_argument = click.argument("run", type=FOLDER)
scene_option = click.option(
    "--stage", "chosen", help="Stage whose scene to use.  [default: the last finished one]"
)


threads_option = click.option(
    "--threads",
    type=click.IntRange(min=1),
    default=usable_cores,
    help="Number of CPU threads, which does not change results.  [default: all cores]",
)


def output_option(
    help: str, name: str, *, metavar: str | None = None, required: bool = True
) -> Callable[[F], F]:
    """Return the option ``-o`` of a command that fills a folder."""
    return click.option("-o", "--output", name, metavar=metavar, required=required, type=FOLDER, help=help)


def file_option(help: str) -> Callable[[F], F]:
    """Return the option ``-o`` of a command that writes a file; ``help`` lists the endings of the formats."""
    help = f"The new file. Its ending chooses the format: {help}"
    return click.option("-o", "--output", required=True, type=FILE, help=help)


def report_option(help: str) -> Callable[[F], F]:
    """Return the option ``--report`` of a command that writes a report at its end by default."""
    return click.option(
        "--report/--no-report", "wants_report", default=True, help=f"{help}  [default: report]"
    )


def parse_size(
    context: click.Context, parameter: click.Parameter, value: str | None
) -> tuple[int, int] | None:
    """Parse the option for the size of pictures, as a callback of click; None if it is not given."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+)x(\d+)", value)
    if not match or not all(16 <= int(side) <= 8192 for side in match.groups()):
        raise click.BadParameter("give WIDTHxHEIGHT in pixels, for example 480x270 (16 to 8192 per side)")
    return int(match[1]), int(match[2])


quality_option = click.option(
    "--quality",
    type=click.Choice(get_args(Quality)),
    callback=lambda context, parameter, value: () if value is None else (f"g0.quality={value}",),
    help="Cost of all trainings: draft for a first impression, standard for a scene to publish, high for "
    "four times as many steps and twice as many Gaussians. It does not change steps and budgets that a "
    "recipe sets.  [default: standard]",
)


def work_options(command: F) -> F:
    """Add the options of commands that compute: ``--device`` and ``--threads``."""
    command = click.option(
        "--device",
        type=click.Choice(["auto", "cpu", "cuda"]),
        default="auto",
        show_default=True,
        help="Device to compute on. auto takes an NVIDIA GPU that passed its self-test (cleargs doctor "
        "--gpu) and is faster than the CPU.",
    )(command)
    return threads_option(command)


def manifest_json(manifest: Manifest) -> dict[str, Any]:
    """Return the state of a stage as JSON values."""
    names = ("status", "key", "digest", "started", "seconds", "device", "summary")
    return {
        **{name: getattr(manifest, name) for name in names},
        "missing": [*manifest.inherited, *manifest.missing],
        "files": len(manifest.files),
        "bytes": manifest.bytes,
        "versions": {**manifest.versions, **manifest.parts.libraries},
    }


def print_json(value: Any) -> None:
    """Print ``value`` as indented JSON on stdout."""
    click.echo(json.dumps(value, indent=2, ensure_ascii=False))


def answer(as_json: bool, facts: Any, *lines: str) -> None:
    """Print ``facts`` as JSON, or else ``lines``."""
    if as_json:
        print_json(facts)
    else:
        for line in lines:
            click.echo(line)
