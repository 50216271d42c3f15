"""The program ``cleargs``: its commands, and the exit codes of errors."""

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
"""Exit code after Ctrl-C, as in shells: 128 + SIGINT."""

COMMANDS: dict[str, tuple[str, str]] = {
    "run": ("cleargs.cli.run", "Turn a capture into a clean scene: run all missing stages."),
    "status": ("cleargs.cli.run", "Show which stages are done, and what changed if one is not."),
    "show": ("cleargs.cli.show", "Show the tables and figures of a run or of one stage."),
    "watch": ("cleargs.cli.report", "Follow a run in the browser, then see its report."),
    "report": ("cleargs.cli.report", "Write the report of a run: the scene in 3D, and every frame."),
    "render": ("cleargs.cli.render", "Render pictures and films of the scene."),
    "export": ("cleargs.cli.export", "Write the scene for a viewer or another program."),
    "eval": ("cleargs.cli.eval", "Measure the quality of a scene with sharp images."),
    "batch": ("cleargs.cli.batch", "Run all scenes of a sheet."),
    "stage": ("cleargs.cli.run", "Run one stage of a prepared run."),
    "settings": ("cleargs.cli.settings", "List all settings with default, range and meaning."),
    "models": ("cleargs.cli.models", "List, install and verify model weights."),
    "synth": ("cleargs.cli.synth", "Make a synthetic capture with known ground truth."),
    "verify": ("cleargs.cli.store", "Check every file of a run for damage."),
    "gc": ("cleargs.cli.store", "Remove results that no run links to."),
    "doctor": ("cleargs.cli.doctor", "Check this machine: versions, memory, disk, device."),
}
"""Command -> (module with the click command of that name, where _ replaces -; line in ``cleargs --help``)."""

ALIASES = {"explain": "status"}
"""Old name of a command -> its name."""

EPILOG = """\b
Examples:
  cleargs run video.mp4 -o room              a video, an image folder, a COLMAP project ...
  cleargs run video.mp4 -o room --set rva.tau_R=0.7
  cleargs show room                          results of each stage
  cleargs status room                        which stages are done, and which setting changed
  cleargs settings g0                        settings of a stage
  cleargs report room                        a page for your browser: room/report/index.html
  cleargs render room -o room.mp4            a film along the capture's path
  cleargs export room -o room.compressed.ply

\b
Exit codes: 0 done, 1 the work failed, 2 wrong usage or bad input, 3 done only in part,
130 interrupted (give the same command again to resume).

Terms: docs/glossary.md
"""


class LazyGroup(click.Group):
    """A group that imports the module of a command only when the command is used, so that help is fast."""

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
    consolidate (the final scene). Results are cached: the same command again runs only the stages that are
    missing.
    """


def main(arguments: Sequence[str] | None = None, dag: Dag | None = None, program: click.Group = cli) -> None:
    """Run the command line of ``program`` and exit. ``dag`` replaces the installed stages in tests."""
    from cleargs.cli.terminal import handle_signals, protect_streams

    protect_streams()
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        handle_signals()
        code = invoke(given, dag, program)
    except KeyboardInterrupt:  # before the command began, or after it ended
        code = _interrupted()
    if code == INTERRUPTED:
        # An orderly exit of torch and Numba may take seconds, and nothing depends on it.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def invoke(arguments: list[str], dag: Dag | None = None, program: click.Group = cli) -> int:
    """Run one command and return its exit code.

    An error is printed on stderr: a line with the cause, and one with a hint. ``--debug``, anywhere among the
    arguments, adds the traceback.
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
    except click.exceptions.NoArgsIsHelpError as error:  # a group without a command: its help
        error.show()
        return error.exit_code
    except BrokenPipeError:
        return 1  # the reader of the output has closed its pipe
    except Exception as error:
        if debug:
            traceback.print_exc()
        code, cause, remedy = explanation(error)
        click.echo(f"error: {cause}", err=True)
        click.echo(f"hint: {remedy}", err=True)
        return code


def _interrupted() -> int:
    from cleargs.cli.terminal import INTERRUPTED_LINE

    click.echo(INTERRUPTED_LINE, err=True)
    return INTERRUPTED


def explanation(error: Exception) -> tuple[int, str, str]:
    """Return exit code, cause and hint for an error. Cause and hint are one line each."""
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
            return 1, cause, "repeat the command with --debug to see the traceback, and please report it"


def _is_out_of_memory(error: BaseException | None) -> bool:
    """Return True if the cause is a lack of memory.

    Threads and libraries that fail to load have different messages for it. A package may hide the message
    of its library, so the cause of an error is checked too.
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
