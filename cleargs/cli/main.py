"""The program ``cleargs``: its commands, and the exit codes of errors."""

from __future__ import annotations

import errno
import os
import resource
import sys
import traceback
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from shlex import quote
from typing import get_args

import click

import cleargs
from cleargs.cli.commands import ALIASES, COMMANDS, SECTIONS, as_called
from cleargs.errors import CleargsError, InputError
from cleargs.files import no_space
from cleargs.pipeline.stages import Stages, installed
from cleargs.plugins import ExtensionPoint, package_of, plugins
from cleargs.safe_io import printable, require_utf8

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells: 128 + SIGINT."""

VIDEOS = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi"})
"""Endings of names that users may give in place of a command."""

EPILOG = """\b
Examples:
  cleargs run walk.mp4                       the scene is walk/scene.ply, the report walk/report.html
  cleargs run walk.mp4 --quality draft       a first look, within minutes
  cleargs run walk.mp4 --set rva.tau_R=0.7   repeats only the stages that this setting affects
  cleargs export walk --for blender          also unreal, unity, supersplat, web
  cleargs completion bash >> ~/.bashrc       complete commands, stages, settings and recipes with TAB

\b
Defaults for store, device, threads and quality: ~/.config/cleargs/config.toml, as `device = "cpu"`.

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

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if name in COMMANDS or name in ALIASES or name.startswith("-"):
            return super().resolve_command(ctx, args)
        path = Path(name)
        if path.exists() or path.suffix.lower() in VIDEOS:
            known = (
                f"did you mean cleargs {'show' if (path / 'run.toml').is_file() else 'run'} {quote(name)}?"
            )
        else:
            near = get_close_matches(name, (*COMMANDS, *ALIASES), n=1)
            known = f"did you mean cleargs {ALIASES.get(near[0], near[0])}?" if near else "see cleargs --help"
        raise InputError(f"there is no command {name!r}", hint=known)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        *sections, (last, more) = SECTIONS.items()
        for title, commands in sections:
            with formatter.section(title):
                formatter.write_dl([(name, line) for name, (_, line) in commands.items()])
        with formatter.section(last):
            formatter.write_text(", ".join(more))


@click.group(
    "cleargs", cls=LazyGroup, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(cleargs.__version__, "-V", "--version", prog_name="cleargs")
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
def cli(debug: bool) -> None:
    """Turn a handheld video of mixed quality into a clean 3D Gaussian Splatting scene.

    Five stages: ingest (poses), rva (which frames to trust), g0 (a first scene), rivr (repaired views) and
    consolidate (the final scene). Results are cached: the same command again runs only the stages that are
    missing.
    """


def main(
    arguments: Sequence[str] | None = None, dag: Stages | None = None, program: click.Group = cli
) -> None:
    """Run the command line of ``program`` and exit. ``dag`` replaces the installed stages in tests."""
    from cleargs.cli.terminal import handle_signals, protect_streams

    protect_streams()
    try:
        handle_signals()
        code = invoke(list(sys.argv[1:] if arguments is None else arguments), dag, program)
    except KeyboardInterrupt:  # before the command began, or after it ended
        code = _interrupted()
    if code == INTERRUPTED:
        # An orderly exit of torch and Numba may take seconds, and nothing depends on it.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def invoke(arguments: list[str], dag: Stages | None = None, program: click.Group = cli) -> int:
    """Run one command and return its exit code.

    An error is printed on stderr: a line with the cause, and one with a hint. ``--debug``, anywhere among the
    arguments, adds the traceback.
    """
    from cleargs.cli.user_config import user_defaults

    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    try:
        for argument in arguments:
            require_utf8(argument)
        code = program.main(
            arguments,
            prog_name=program.name,
            standalone_mode=False,
            obj=dag or installed(),
            default_map=user_defaults(COMMANDS),
        )
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
        click.echo(as_called(f"hint: {remedy}"), err=True)
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
            limit, remedy = resource.getrlimit(resource.RLIMIT_AS)[0], "close other programs"
            if limit != resource.RLIM_INFINITY:
                remedy = f"raise the limit on virtual memory, {limit / 1e9:.1f} GB: ulimit -v unlimited"
            return 1, "out of memory", f"{remedy}, or lower ingest.max_size or ingest.max_frames"
        case OSError() if error.errno in (errno.ENOSPC, errno.EDQUOT):
            full = no_space(Path(error.filename or ".").absolute().parent)
            return 1, str(full), full.hint
        case OSError():
            cause = f"{error.strerror or _one_line(error)}{f': {error.filename}' if error.filename else ''}"
            if error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
                return 2, cause, "choose another path"
            return 1, cause, "check the disk and its permissions"
        case _:
            cause = f"unexpected {type(error).__name__}: {_one_line(error)}"
            if isinstance(error, ValueError) and (names := _variables(error)):
                cause = f"the environment variable {' or '.join(names)} cannot be used: {_one_line(error)}"
                return 2, cause, "correct or unset it"
            if package := failed_plugin(error):
                cause = f"the plugin of {package} failed: {type(error).__name__}: {_one_line(error)}"
                return 1, cause, "repeat the command with --debug to see the traceback, and repair the plugin"
            return 1, cause, "repeat the command with --debug to see the traceback, and please report it"


def failed_plugin(error: Exception) -> str | None:
    """Return name and version of the package with plugins whose code raised ``error``; None if none did."""
    packages = {
        plugin.module.partition(".")[0]: " ".join(package_of(plugin))
        for point in get_args(ExtensionPoint)
        for plugin in plugins(point).values()
    }
    modules = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
    return next((packages[top] for name in modules if (top := name.partition(".")[0]) in packages), None)


def _variables(error: Exception) -> list[str]:
    """Return NAME=VALUE of the environment variables that the library which raised ``error`` reads.

    They are named in the line that raised it, or begin with the name of the library (NUMBA_...).
    """
    found = []
    for last in traceback.extract_tb(error.__traceback__)[-1:]:
        library = last.filename.partition("site-packages/")[2].partition("/")[0].upper()
        for name in os.environ if library else ():
            if f"'{name}'" in (last.line or "") or name.startswith(f"{library}_"):
                found.append(f"{name}={os.environ[name]}")
    return found


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
