"""The console script ``cleargs``: its commands, and how errors become exit codes."""

from __future__ import annotations

import errno
import os
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module

import click

import cleargs
from cleargs.errors import CleargsError
from cleargs.pipeline.dag import Dag, installed
from cleargs.safe_io import printable, require_utf8

INTERRUPTED = 130

COMMANDS: dict[str, tuple[str, str]] = {
    "run": ("cleargs.cli.run", "Turn a capture into a clean scene: all stages, or those that are missing."),
    "status": ("cleargs.cli.run", "Say for each stage whether it is done, and what changed if not."),
    "show": ("cleargs.cli.show", "Show the tables and figures of a run or of one stage."),
    "watch": ("cleargs.cli.report", "Show a run in the browser while it is at work, then its report."),
    "report": ("cleargs.cli.report", "Write a page that shows a run: the scene in 3D, and every frame."),
    "render": ("cleargs.cli.render", "Render the scene: stills, and films along a path."),
    "export": ("cleargs.cli.export", "Write the scene for a viewer or another program."),
    "eval": ("cleargs.cli.eval", "Measure a scene against sharp images."),
    "batch": ("cleargs.cli.batch", "Bring all scenes of a sheet through the stages."),
    "stage": ("cleargs.cli.run", "Run one stage of a prepared run."),
    "settings": ("cleargs.cli.settings", "List every setting: default, range, meaning."),
    "models": ("cleargs.cli.models", "List, install and verify model weights."),
    "synth": ("cleargs.cli.synth", "Make a synthetic capture with known truth."),
    "verify": ("cleargs.cli.store", "Read every file of a run again, and name what is damaged."),
    "gc": ("cleargs.cli.store", "Remove results that no run links to."),
    "doctor": ("cleargs.cli.doctor", "Check this machine: versions, memory, disk, device."),
}
"""Command -> (module that holds the click command of that name, _ for -; its line in ``cleargs --help``)."""

ALIASES = {"explain": "status"}
"""Old name of a command -> its name."""

EPILOG = """\b
Examples:
  cleargs run video.mp4 -o room              a video, an image folder, a COLMAP project ...
  cleargs run video.mp4 -o room --set rva.tau_R=0.7
  cleargs show room                          what each stage found
  cleargs status room                        what is done, what is missing, and which setting changed
  cleargs settings g0                        what a stage can be told
  cleargs report room                        a page to look at: room/report/index.html
  cleargs render room -o room.mp4            a film along the capture's path
  cleargs export room -o room.compressed.ply

\b
Exit codes: 0 done, 1 the work failed, 2 wrong usage or bad input, 3 done only in part,
130 interrupted (the same command resumes).

Terms: docs/glossary.md
"""


class LazyGroup(click.Group):
    """A group that imports a command's module only when the command is used: help stays quick."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        cmd_name = ALIASES.get(cmd_name, cmd_name)
        if cmd_name not in COMMANDS:
            return None
        command = getattr(import_module(COMMANDS[cmd_name][0]), cmd_name.replace("-", "_"))
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])


@click.group(
    "cleargs", cls=LazyGroup, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(cleargs.__version__, prog_name="cleargs")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
def cli(debug: bool) -> None:
    """Turn a handheld video of mixed quality into a clean 3D Gaussian Splatting scene.

    Five stages: ingest (poses), rva (which frames to trust), g0 (a first scene), rivr (repaired views) and
    consolidate (the final scene). Results are kept by content: the same command again does only what is
    missing.
    """


def main(arguments: Sequence[str] | None = None, dag: Dag | None = None, program: click.Group = cli) -> None:
    """Run the command line of ``program`` and exit. ``dag`` replaces the installed stages (tests)."""
    from cleargs.cli.terminal import answer_signals, protect_streams

    protect_streams()
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        answer_signals()
        code = invoke(given, dag, program)
    except KeyboardInterrupt:  # before the command began, or after it ended
        code = _interrupted()
    if code == INTERRUPTED:
        # Taking torch and Numba down in order may take seconds, and nothing waits for it.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def invoke(arguments: list[str], dag: Dag | None = None, program: click.Group = cli) -> int:
    """Run one command; returns its exit code. Errors go to stderr as one line of cause and one of remedy.

    ``--debug`` may stand anywhere.
    """
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    try:
        for argument in arguments:
            require_utf8(argument)
        code = program.main(arguments, prog_name=program.name, standalone_mode=False, obj=dag or installed())
        return int(code or 0)
    except (KeyboardInterrupt, click.Abort):
        return _interrupted()
    except click.exceptions.NoArgsIsHelpError as error:  # a group alone: what it offers
        error.show()
        return error.exit_code
    except BrokenPipeError:
        return 1  # whoever read our output has gone
    except Exception as error:
        if debug:
            traceback.print_exc()
        code, cause, remedy = explanation(error)
        click.echo(f"error: {cause}", err=True)
        click.echo(f"hint: {remedy}", err=True)
        return code


def _interrupted() -> int:
    click.echo("interrupted; finished work is kept, and the same command resumes from there", err=True)
    return INTERRUPTED


def explanation(error: Exception) -> tuple[int, str, str]:
    """Exit code, cause and remedy for an error, each of the two in one line."""
    match error:
        case CleargsError():
            return error.exit_code, _one_line(error), _one_line(error.hint)
        case click.ClickException():
            context = getattr(error, "ctx", None)
            command = context.command_path if context is not None else "cleargs"
            return error.exit_code, _one_line(error.format_message()), f"see {command} --help"
        case _ if _is_out_of_memory(error):
            return 1, "out of memory", "lower ingest.max_size or ingest.max_frames, or close other programs"
        case OSError() if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return 1, "no space left on the disk", "free some space (cleargs gc), or choose another --store"
        case OSError() if error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
            where = f": {error.filename}" if error.filename else ""
            return 2, f"{error.strerror}{where}", "choose another path"
        case OSError():
            where = f": {error.filename}" if error.filename else ""
            return 1, f"{error.strerror or _one_line(error)}{where}", "check the disk and its permissions"
        case _:
            cause = f"unexpected {type(error).__name__}: {_one_line(error)}"
            return 1, cause, "run it again with --debug for the traceback, and please report it"


def _is_out_of_memory(error: BaseException | None) -> bool:
    """Whether memory ran out, which threads and libraries that are being loaded say in words of their own.

    A package whose library cannot be loaded may put words of its own over the cause.
    """
    text = str(error)
    match error:
        case MemoryError():
            return True
        case RuntimeError():
            return any(
                words in text for words in ("can't start new thread", "can't allocate memory")
            ) or _is_out_of_memory(error.__cause__ or error.__context__)
        case ImportError() | OSError():
            return any(words in text for words in ("failed to map segment", "Cannot allocate memory"))
        case _:
            return False


def _one_line(text: object) -> str:
    return printable(" ".join(str(text).split())) or "no further details"
