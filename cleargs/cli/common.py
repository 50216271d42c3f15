"""Options and output functions that several commands share."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar, get_args

import click

from cleargs.cli.commands import as_called
from cleargs.cli.progress_bars import LOG, VERBOSE, LineFile, check_log
from cleargs.errors import InputError, StoreError
from cleargs.manifest import Manifest
from cleargs.pipeline.config import recipe_names
from cleargs.pipeline.run_file import RUN_FILE
from cleargs.pipeline.session import usable_cores
from cleargs.pipeline.settings import settings_of
from cleargs.pipeline.stages import installed
from cleargs.progress import Say
from cleargs.splat.config import STEPS_FACTOR, Quality

F = TypeVar("F", bound=Callable[..., Any])

DONE_IN_PART = 3
"""Exit code of work that is done only in part."""

FOLDER = click.Path(file_okay=False, path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)

SHORTCUTS = {
    "quality": "g0.quality",
    "steps": "g0.steps",
    "max_frames": "ingest.max_frames",
    "size": "ingest.max_size",
    "holdout": "ingest.holdout",
    "start": "ingest.start",
    "end": "ingest.end",
    "only": "ingest.only",
    "skip": "ingest.skip",
}
"""Option -> the setting that it changes."""

store_option = click.option(
    "--store",
    envvar="CLEARGS_STORE",
    show_envvar=True,
    type=FOLDER,
    help="Folder of the results, which several runs may share.  [default: RUN/.store]",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def quiet_option(command: F) -> F:
    """Add the options ``-q``, ``--log`` and ``--progress``. The command receives ``quiet``."""

    def keep(context: click.Context, parameter: click.Parameter, value: Any) -> None:
        if parameter.name == "log":
            value = None if value is None else LineFile(value)
        context.meta[f"cleargs.{parameter.name}"] = value

    for option in (
        click.option(
            "--progress",
            type=click.Choice(["auto", "lines", "json"]),
            default="auto",
            expose_value=False,
            callback=keep,
            help="Progress on stderr: bars on a terminal and lines elsewhere (auto), lines, or one JSON "
            "object per event.  [default: auto]",
        ),
        click.option(
            "--log", type=FILE, expose_value=False, callback=keep, help="Also write messages to this file."
        ),
        click.option("-q", "--quiet", is_flag=True, help="Print warnings and results only."),
    ):
        command = option(command)
    return command


partial_option = click.option(
    "--allow-partial", is_flag=True, help="Continue after a stage that is done only in part."
)
run_argument = click.argument("run", type=FOLDER)
scene_argument = click.argument("run", metavar="RUN|SCENE", type=click.Path(exists=True, path_type=Path))


verbose_option = click.option(
    "-v",
    "--verbose",
    is_flag=True,
    expose_value=False,
    callback=lambda context, parameter, value: context.meta.update({VERBOSE: value}),
    help="Also print device, store, and cost of each stage.",
)


@contextmanager
def kept_log(context: click.Context, path: Path, *, writes: bool) -> Iterator[Say]:
    """If ``writes`` is true, also write the messages of a command, and its final error, to ``path``.

    Yields a function for details, which the terminal shows only with ``-v``.
    """
    chosen: Say | None = context.meta.get(LOG)
    if isinstance(chosen, LineFile):
        check_log(chosen.path, context)
    file = LineFile(path, needed=RUN_FILE)  # nothing is written into a folder that is not a run

    def log(text: str) -> None:
        if chosen is not None:
            chosen(text)
        if writes:
            with suppress(StoreError):  # the run itself does not need its log
                file(text)

    def detail(text: str) -> None:
        log(text)
        if context.meta.get(VERBOSE):
            click.echo(text, err=True)

    context.meta[LOG] = log
    try:
        yield detail
    except BaseException as error:
        from cleargs.cli.main import explanation

        cause = explanation(error)[1] if isinstance(error, Exception) else "interrupted"
        log(f"error: {cause}")
        raise


def completed(names: Callable[[], Iterable[str]]) -> Callable[..., list[str]]:
    """Return a function with which click completes a value to the ``names`` that begin with it."""
    return lambda context, parameter, begin: [name for name in names() if name.startswith(begin)]


def setting_names() -> list[str]:
    """Return all settings, each with the ``=`` that follows in ``--set``."""
    dag = installed()
    return [f"{one.name}=" for name in dag.names for one in settings_of(name, dag.load(name).CONFIG)]


complete_stage = completed(lambda: installed().names)
scene_option = click.option(
    "--stage",
    "chosen",
    shell_complete=complete_stage,
    help="Stage whose scene to use.  [default: the last finished one]",
)
edited_option = click.option(
    "--scene",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="FILE",
    help="Use this edited copy in place of the scene of RUN. To make one, export without --up, "
    "--upright, --world and --metres, and delete or change Gaussians in an editor.",
)
until_option = click.option(
    "--until", metavar="STAGE", shell_complete=complete_stage, help="The last stage to run."
)
recipe_option = click.option(
    "--recipe",
    "--workflow",
    "recipe",
    metavar="NAME|FILE.toml",
    shell_complete=completed(recipe_names),
    help="default, smoke, paper, paper-open, or your TOML file.  [default: default; an existing run keeps "
    "its settings]",
)
set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="STAGE.FIELD=VALUE",
    shell_complete=completed(setting_names),
    help="Change one setting. `cleargs settings` lists them.",
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


def report_option(help: str) -> Callable[[F], F]:
    """Return the option ``--report`` of a command that writes a report at its end by default."""
    return click.option(
        "--report/--no-report", "wants_report", default=True, help=f"{help}  [default: report]"
    )


def open_option(help: str) -> Callable[[F], F]:
    """Return the option ``--open`` of a command that writes or serves a page, as the parameter ``opens``."""
    return click.option("--open", "opens", is_flag=True, help=help)


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
    help="The cost of a run: draft is a preview of at most 60 frames of 640 px, without repairs; standard "
    f"is for publishing; high takes {STEPS_FACTOR['high']:.0f} times its steps and twice its Gaussians. "
    "Steps and budgets in the recipe are kept.  [default: that of the run; standard for a new run]",
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
    click.echo(json.dumps(value, indent=2, ensure_ascii=False))


def answer(as_json: bool, facts: Any, *lines: str) -> None:
    """Print ``facts`` as JSON, or else ``lines``, with commands as the user calls them."""
    if as_json:
        print_json(facts)
    else:
        for line in lines:
            click.echo(as_called(line))


def _limits(context: click.Context, parameter: click.Parameter, value: tuple[str, ...]) -> dict[str, float]:
    found = {}
    for text in value:
        name, _, number = text.partition("=")
        try:
            found[name] = float(number)
        except ValueError:
            raise click.BadParameter(f"{text!r} does not have the form FIGURE=VALUE") from None
    return found


def fail_below_option(figures: str) -> Callable[[F], F]:
    """Return the option ``--fail-below``. Its value maps figure -> limit; the help lists ``figures``."""
    return click.option(
        "--fail-below",
        multiple=True,
        metavar="FIGURE=VALUE",
        callback=_limits,
        help=f"End with exit code 1 if this figure of a result is below VALUE, or missing: {figures}.",
    )


def report_below(results: Mapping[str, Mapping[str, Any]], limits: Mapping[str, float]) -> bool:
    """Print a line on stderr for each figure of ``results`` that is missing or below its limit.

    Return True if there is one. Raises InputError if no result has a figure of this name.
    """
    failed = False
    for figure, limit in limits.items():
        if results and not any(figure in figures for figures in results.values()):
            known = ", ".join(sorted({name for figures in results.values() for name in figures}))
            raise InputError(f"there is no figure {figure!r}", hint=f"choose one of {known}")
        for name, figures in results.items():
            value = figures.get(figure)
            if value is None or value < limit:
                failed = True
                click.echo(f"below the limit: {name}: {figure} {value} < {limit:g}", err=True)
    return failed


def with_shortcuts(overrides: Sequence[str], values: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the settings of the options in ``values`` (`SHORTCUTS`; None: not given), then ``overrides``.

    Raises InputError if ``overrides`` has one of these settings too.
    """
    named = {text.partition("=")[0].strip() for text in overrides}
    given = {SHORTCUTS[option]: (option, value) for option, value in values.items() if value is not None}
    for setting, (option, _) in given.items():
        if setting in named:
            flag = f"--{option.replace('_', '-')}"
            raise InputError(f"{flag} and --set {setting} are the same setting", hint="give one of them")
    return (*(f"{setting}={value}" for setting, (_, value) in given.items()), *overrides)
