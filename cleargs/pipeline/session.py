"""Choose device, store and settings of a run, for the command line and the library."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from cleargs.digest import DigestMemo
from cleargs.errors import ConfigError, InputError, listed
from cleargs.gpu import NO_GPU, Machine
from cleargs.packed import require_images
from cleargs.pipeline.config import check_document, known_settings, load_config
from cleargs.pipeline.run_file import (
    RUN_FILE,
    RunMetadata,
    RunSpec,
    checked_store,
    damaged_run_file,
    known_metadata,
    located,
    read_metadata,
    require_store,
)
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import MEMO, STORE_FOLDER, Store, check_store, is_store, visible_names
from cleargs.progress import Reporter
from cleargs.types import Device

DeviceChoice = Literal["auto", "cpu", "cuda"]


def usable_cores() -> int:
    """Return the number of CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def resolve_device(
    choice: DeviceChoice,
    say: Callable[[str], None],
    *,
    kept: Device | None = None,
    test: bool = False,
    machine: Machine | None = None,  # None: this one
) -> Device:
    """Return the device to use, without an import of torch, which would take seconds.

    | choice | of the run (``kept``) | device |
    |---|---|---|
    | cpu | any | CPU |
    | cuda | any | GPU |
    | auto | cpu | CPU |
    | auto | cuda | GPU; InputError if it failed its self-test |
    | auto | none | GPU if it passed its self-test and is faster, else CPU; the reason goes to ``say`` |

    With ``test``, a GPU that was not tested yet is tested. Raises InputError if a GPU in the table cannot be
    used.
    """
    if choice == "cpu" or (choice == "auto" and kept == "cpu"):
        return "cpu"
    machine = machine or Machine()
    obstacle = machine.obstacle()
    if obstacle is not None and (choice == "cuda" or kept == "cuda"):
        raise InputError(f"--device cuda cannot be used: {obstacle}", hint="use --device cpu")
    if choice == "cuda":
        return "cuda"
    if obstacle is not None:
        if obstacle != NO_GPU:
            say(f"device: the CPU, because {obstacle}")
        return "cpu"
    facts = machine.facts()
    tested = machine.cached_test(facts) or (machine.self_test(facts, say) if test else None)
    if kept == "cuda":
        if tested is not None and tested.fault is not None:
            raise InputError(
                f"the run used the GPU, but {tested.reason}",
                hint="run its stages again with --device cpu, or stay on the GPU with --device cuda",
            )
        return "cuda"
    if tested is None:
        say("device: the CPU, because the GPU is not tested yet (cleargs doctor --gpu tests it)")
        return "cpu"
    say(f"device: the {'GPU' if tested.device == 'cuda' else 'CPU'}, because {tested.reason}")
    return tested.device


@contextmanager
def opened_store(root: Path) -> Iterator[Store]:
    """Yield the store at ``root`` with its digest memo. The folder is created when the first stage starts.

    Raises InputError if the folder has content that is not of a store, and StoreError like `check_store`.
    """
    root = root.absolute()
    check_store(root)
    with DigestMemo(root / MEMO) as memo:
        yield Store(root, memo)


def default_folder(source: Path) -> Path:
    """Return the run folder of a capture for which none is given: next to it, and never the capture.

    It is ``walk`` for ``walk.mp4``, and ``walk-scene`` for a folder ``walk`` or if ``walk`` is something else
    than a run.
    """
    path = source if source.name not in ("", "..") else source.resolve()
    folder = path.with_suffix("") if path.is_file() else path
    if folder.exists() and not (folder / RUN_FILE).is_file():
        folder = folder.with_name(f"{folder.name}-scene")
    return folder


def resolve_run(
    dag: Stages,
    source: Path,
    folder: Path,
    *,
    recipe: str | None = None,
    overrides: Sequence[str] = (),
    seed: int | None = None,
    reset: bool = False,
    store: Path | None = None,
    device: DeviceChoice = "auto",
    test_gpu: bool = True,
    reporter: Reporter,
) -> RunSpec:
    """Return the run of a capture, with everything that decides its results.

    An existing run keeps its settings, store and device unless an argument gives others. A ``recipe`` or
    ``reset`` starts from the recipe instead. ``test_gpu`` lets the device "auto" run the self-test of a GPU.
    ``reporter`` receives messages about the device, and about settings that the run keeps or loses. Raises
    InputError if ``source`` does not exist or is a run, and ConfigError if a setting is unknown or unusable.
    """
    for place in (folder, source):
        require_images(place, "continuing it")
    if not source.exists():
        hint = "give a video, an image folder or a COLMAP project"
        if (folder / RUN_FILE).is_file():
            hint = f"if it was moved, its results are still used: cleargs run NEWPLACE -o {folder}"
        raise InputError(f"{source} does not exist", hint=hint)
    if (source / RUN_FILE).is_file():
        made_from = known_metadata(source).source
        raise InputError(
            f"{source} is a run, not a capture",
            hint=f"give the capture of this run{f': {made_from}' if made_from else ''}",
        )
    folder, forgets = located(folder), reset or recipe is not None
    is_run = (folder / RUN_FILE).is_file() or is_store(folder / STORE_FOLDER)
    if not is_run and folder != source.absolute() and (names := visible_names(folder)):
        raise InputError(
            f"{folder} is not empty and is not a run; it has {listed(names)}",
            hint=f"choose a new or empty folder, for example -o {folder / default_folder(source).name}",
        )
    metadata, kept = RunMetadata(), None
    try:
        metadata = read_metadata(folder)
        if metadata.damaged:
            raise damaged_run_file(folder)
        settings, others = known_settings(dag, {} if forgets else metadata.settings)
        kept = check_document(dag, settings) if settings else None
        if others:
            reporter.warn(f"{folder / RUN_FILE} has settings that do not exist, left out: {listed(others)}")
    except ConfigError as error:
        if not forgets:
            raise ConfigError(
                f"the settings of {folder} cannot be used: {error}", hint="start from the recipe with --reset"
            ) from error
    config = load_config(dag, recipe or "default" if kept is None else kept.document(), overrides, seed)
    root = (store or metadata.store or folder / STORE_FOLDER).absolute()
    if root == metadata.store:
        require_store(folder, metadata)
    root = checked_store(folder, root)
    chosen = resolve_device(device, reporter.info, kept=metadata.device, test=test_gpu)
    if kept is not None:
        own = [f"seed={kept.seed}"] if kept.seed else []
        own += [f"{setting.name}={value}" for setting, value in kept.settings() if value != setting.default]
        if own:
            reporter.info(
                f"settings kept from {folder / RUN_FILE}: {listed(own)}; --reset starts from the recipe"
            )
    return RunSpec(folder, source.absolute(), config, root, chosen)
