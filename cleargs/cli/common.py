"""What several commands share: options, and opening a run with its store."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeVar

import click

from cleargs.errors import InputError
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.digest import DigestMemo
from cleargs.pipeline.run_file import Device
from cleargs.pipeline.store import Store

F = TypeVar("F", bound=Callable[..., Any])

SCENE = "scene.ply"
"""What a stage that trains leaves."""

DeviceChoice = Literal["auto", "cpu", "cuda"]

store_option = click.option(
    "--store",
    envvar="CLEARGS_STORE",
    show_envvar=True,
    type=click.Path(file_okay=False, path_type=Path),
    help="Where results are kept; may be shared by runs.  [default: RUN/.store]",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Print warnings and results only.")
force_help = "Make the stage again, even if its results are there."
partial_option = click.option(
    "--allow-partial", is_flag=True, help="Go on after a stage that is done only in part."
)
stale_option = click.option(
    "--stale", is_flag=True, help="Take results that were made with other settings or inputs than the run's."
)
UNUSED_GPU = "there is an NVIDIA GPU, which --device auto does not use yet: --device cuda does"
run_argument = click.argument("run", type=click.Path(file_okay=False, path_type=Path))


def parse_size(
    context: click.Context, parameter: click.Parameter, value: str | None
) -> tuple[int, int] | None:
    """The callback of an option for a size of pictures; None where it is not given."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d+)x(\d+)", value)
    if not match or not all(16 <= int(side) <= 8192 for side in match.groups()):
        raise click.BadParameter("write WIDTHxHEIGHT in pixels, 480x270 say (16 to 8192 a side)")
    return int(match[1]), int(match[2])


def scene_stage(dag: Dag, run: Path, chosen: str | None) -> str:
    """The stage whose scene to take: ``chosen``, or the last that has one.

    Raises InputError when there is no such scene.
    """
    done = [name for name in dag.names if (run / name / SCENE).is_file()]
    stage = done[-1] if done and chosen is None else chosen and dag.check(chosen)
    if stage is None:
        raise InputError(f"there is no scene in {run}", hint=f"see cleargs explain {run}")
    if stage not in done:
        there = f"the stages with a scene are {', '.join(done)}" if done else f"see cleargs explain {run}"
        raise InputError(f"{stage} has no scene in {run}", hint=there)
    return stage


def work_options(command: F) -> F:
    """Options of the commands that run stages."""
    command = click.option(
        "--device",
        type=click.Choice(["auto", "cpu", "cuda"]),
        default="auto",
        show_default=True,
        help="Where to compute. Today auto is the CPU: the GPU back end awaits its first run on a device.",
    )(command)
    return click.option(
        "--threads",
        type=click.IntRange(min=1),
        help="CPU threads; results do not depend on it.  [default: all cores]",
    )(command)


def threads_or_all(threads: int | None) -> int:
    """The given number of threads, or that of the cores which this process may use."""
    return threads or usable_cores()


def usable_cores() -> int:
    """The CPU cores that this process may use, as far as the system says."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def resolve_device(choice: DeviceChoice, say: Callable[[str], None]) -> Device:
    """The device class to use. Looks for a GPU without importing torch, which would cost seconds.

    Where ``auto`` leaves a GPU alone, ``say`` is told. Raises InputError when ``cuda`` is asked for and
    cannot be had.
    """
    obstacle = None if choice == "cpu" else cuda_obstacle()
    if choice != "cuda":  # auto stays on the CPU until tests/gpu/run.sh has passed on a GPU (docs/gpu.md)
        if choice == "auto" and obstacle is None:
            say(UNUSED_GPU)
        return "cpu"
    if obstacle is not None:
        raise InputError(f"--device cuda cannot be used: {obstacle}", hint="use --device cpu")
    return "cuda"


def cuda_obstacle() -> str | None:
    """Why work cannot run on an NVIDIA GPU here; None when it can."""
    if not any(Path(node).exists() for node in ("/dev/nvidiactl", "/dev/dxg")):
        return "there is no NVIDIA GPU"
    if find_spec("triton") is None:
        return "Triton is not installed (pip install 'cleargs[cuda]')"
    if version("torch").endswith("+cpu"):
        return "this PyTorch is built for the CPU only (install a CUDA build)"
    return None


@contextmanager
def opened_store(root: Path) -> Iterator[Store]:
    """The store at ``root`` with its digest memo. Its folder appears when the first stage starts."""
    root = root.absolute()
    with DigestMemo(root / "digests.sqlite") as memo:
        yield Store(root, memo)


def print_json(value: Any) -> None:
    """Print ``value`` as indented JSON on stdout."""
    click.echo(json.dumps(value, indent=2, ensure_ascii=False))
