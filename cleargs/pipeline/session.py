"""How work begins, for the command line and the library alike: device, store, and a run as asked for."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from cleargs.digest import DigestMemo
from cleargs.errors import ConfigError, InputError
from cleargs.pipeline.config import check_document, load_config
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.run_file import (
    RUN_FILE,
    Device,
    RunMetadata,
    RunSpec,
    damaged_run_file,
    read_metadata,
    read_source,
)
from cleargs.pipeline.store import STORE_FOLDER, Store

DeviceChoice = Literal["auto", "cpu", "cuda"]

MOST_NAMED = 3  # settings of an existing run that are named
UNUSED_GPU = "there is an NVIDIA GPU, which --device auto does not use yet: --device cuda does"


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


def resolve_run(
    dag: Dag,
    source: Path,
    folder: Path,
    *,
    workflow: str | None = None,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    reset: bool = False,
    store: Path | None = None,
    device: DeviceChoice = "auto",
    say: Callable[[str], None],
) -> RunSpec:
    """The run of the capture ``source`` in ``folder``, all that decides its results resolved.

    An existing run keeps its settings, its store and its device, each unless it is given here; ``reset``
    forgets the settings, as does a ``workflow``. ``say`` is told what is kept. Raises InputError when
    ``source`` is missing or itself a run, ConfigError for settings that cannot be used.
    """
    if not source.exists():
        raise InputError(f"there is no {source}", hint="give a video, an image folder or a COLMAP project")
    if (source / RUN_FILE).is_file():
        made_from = read_source(source)
        raise InputError(
            f"{source} is a run, not a capture",
            hint=f"give the capture that it was made from{f': {made_from}' if made_from else ''}",
        )
    folder, forgets = folder.absolute(), reset or workflow is not None
    metadata, kept = RunMetadata(), None
    try:
        metadata = read_metadata(folder)
        if metadata.damaged:
            raise damaged_run_file(folder)
        # Checked, they hold no names that are gone: those would contradict what is set now.
        kept = check_document(dag, metadata.settings) if metadata.settings and not forgets else None
    except ConfigError as error:
        if not forgets:
            raise ConfigError(
                f"the settings of {folder} cannot be used: {error}", hint="--reset starts from the recipe"
            ) from error
    config = load_config(dag, workflow or "default" if kept is None else kept.document(), overrides, seed)
    root = (store or metadata.store or folder / STORE_FOLDER).absolute()
    chosen = resolve_device(metadata.device or device if device == "auto" else device, say)
    if kept is not None:
        own = [f"seed={kept.seed}"] if kept.seed else []
        own += [f"{setting.name}={value}" for setting, value in kept.settings() if value != setting.default]
        line = ", ".join(own[:MOST_NAMED]) + (
            f" and {len(own) - MOST_NAMED} more" if own[MOST_NAMED:] else ""
        )
        if own:
            say(f"as in {folder / RUN_FILE}: {line}; --reset starts from the recipe")
    return RunSpec(folder, source.absolute(), config, root, chosen)
