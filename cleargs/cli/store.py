"""``cleargs verify`` and ``gc``: check the files of a run, or remove unused ones from a store."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import click

from cleargs.cli.common import FOLDER, answer, json_option, run_argument, store_option
from cleargs.digest import named_files
from cleargs.errors import InputError
from cleargs.files import remove
from cleargs.manifest import MANIFEST, Manifest, damages, read_manifest, results_folder
from cleargs.own_files import has_only_files, leftovers, refuse_links, size_of
from cleargs.packed import read_pack
from cleargs.pipeline.run_file import SCENE, RunSpec, read_run_file
from cleargs.pipeline.session import opened_store
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import ROOTS, Garbage, Store
from cleargs.report.formatting import count


class StoreFault(NamedTuple):
    """A damaged result or a changed input."""

    kind: Literal["damaged", "changed"]
    stage: str
    what: str


@click.command(
    epilog="""\b
Example:
  cleargs verify room      after a disk error, or before you archive a run
"""
)
@run_argument
@store_option
@json_option
@click.pass_obj
def verify(dag: Stages, run: Path, store: Path | None, as_json: bool) -> int:
    """Check every file of RUN, and every input of it, against the digests in its manifests.

    Other commands do not read a file again if its size and time stamps are unchanged. The next `cleargs run`
    replaces damaged results. The exit code is 1 if something is damaged or changed.
    """
    settings = read_run_file(run, dag, store=store)
    faults: list[StoreFault] = []
    stages: list[str] = []
    files, left_out, packed = 0, 0, read_pack(settings.folder)
    if packed is not None:
        refuse_links([settings.folder / SCENE])
    with opened_store(settings.store) as opened:
        for name in dag.names:
            folder = settings.folder / name
            listed = packed is not None and f"{name}/{MANIFEST}" in packed.files
            if not listed and not folder.is_symlink() and not folder.exists():
                continue  # no results yet; a copy of a run has folders instead of links
            stages.append(name)
            try:
                made = results_folder(settings.folder, name)
                if made is None or (os.path.lexists(made) and not has_only_files(made)):
                    raise ValueError(
                        "there is a link or a device in it, or it is a link that leads elsewhere"
                    )
                manifest = read_manifest(made)
            except (OSError, ValueError) as error:
                gone = f"{MANIFEST} is missing" if listed else "it is no longer in the store"
                text = gone if isinstance(error, OSError) else str(error)
                faults.append(StoreFault("damaged", name, text))
                continue
            there = [x for x in manifest.files if packed is None or f"{name}/{x}" in packed.files]
            files, left_out = files + len(there), left_out + len(manifest.files) - len(there)
            top = [SCENE] if packed is not None and packed.scene == name else []
            for place, names in ((folder.resolve(), set(there) - set(top)), (settings.folder, top)):
                lines = damages(place, manifest, sorted(names), opened.memo, rehash=True)
                faults += [StoreFault("damaged", name, line) for line in lines]
            faults += _changed_inputs(dag, settings, opened, manifest) if packed is None else ()
    if not stages:
        raise InputError(f"{run} has no results yet", hint=f"first: cleargs run {settings.source} -o {run}")
    found = count(len(faults), "fault") if faults else "all unchanged"
    answer(
        as_json,
        {"stages": stages, "files": files, "left_out": left_out, "faults": [x._asdict() for x in faults]},
        *(f"{kind:<8} {stage:<12} {text}" for kind, stage, text in faults),
        f"{files} files of {len(stages)} stages read: {found}",
        *([f"packed run: {left_out} other files were left out when it was packed"] if packed else []),
    )
    if any(fault.kind == "damaged" for fault in faults):
        remedy = f"replace damaged results with `cleargs run {settings.source} -o {run}`"
        click.echo(f"hint: {'unpack the ZIP file again' if packed else remedy}", err=True)
    return 1 if faults else 0


def _changed_inputs(dag: Stages, run: RunSpec, store: Store, manifest: Manifest) -> Iterator[StoreFault]:
    """Yield the inputs of a stage outside the store that changed since its manifest was written."""
    stage = manifest.stage
    for role, place in dag.load(stage).externals(run.config.effective[stage], run.source).items():
        before = manifest.origins.get(role)
        if before is None:
            continue  # the stage ran with other settings, which `cleargs status` shows
        files = named_files(place)
        for name in sorted(before.keys() | files.keys()):
            try:
                if name not in files:
                    change = " is missing"
                elif name not in before:
                    change = " is new"
                elif store.memo.digests_of(files[name], rehash=True)[""] != before[name]:
                    change = " has other content"
                else:
                    continue
            except InputError as error:
                change = f": {error}"
            yield StoreFault("changed", stage, f"{role} {name}".rstrip() + change)


@click.command(
    epilog="""\b
Examples:
  cleargs gc room --dry-run         show what would be removed
  cleargs gc --store /data/store    a store that several runs share
"""
)
@click.argument("run", required=False, type=FOLDER)
@store_option
@click.option(
    "--checkpoints",
    is_flag=True,
    help="Also remove checkpoints of interrupted work, and cached results of single frames.",
)
@click.option("--dry-run", is_flag=True, help="Only show what would be removed.")
@click.option("--yes", is_flag=True, help="Do not ask, for scripts.")
@json_option
@click.pass_obj
def gc(
    dag: Stages,
    run: Path | None,
    store: Path | None,
    checkpoints: bool,
    dry_run: bool,
    yes: bool,
    as_json: bool,
) -> None:
    """Remove the results that no run links to. The store is that of RUN, or --store.

    The command lists what it would remove, and asks. It removes only what has a name that ClearGS gives.

    A run keeps its results as long as its folder exists where it was last used. If you return to settings
    whose results were removed, the stages run again.
    """
    if run is None and store is None:
        raise InputError("no run and no store is given", hint="give RUN or --store DIR")
    root = store if run is None else read_run_file(run, dag, store=store).store
    assert root is not None
    if not root.is_dir():
        raise InputError(f"the store {root} does not exist", hint="give the folder that you used as --store")
    if run is None and not (root / ROOTS).is_dir():  # a store lists its runs there
        raise InputError(
            f"{root} is not a store", hint="give the folder that you used as --store, or RUN without --store"
        )
    with opened_store(root) as opened:
        if run is not None and not dry_run:
            opened.add_root(run.absolute())
        found = opened.collect(dag.names, checkpoints=checkpoints, dry_run=True)
        places = (root, root / ROOTS, *([run] if run else []))
        partial = [Garbage(path, "rubbish", size_of(path)) for place in places for path in leftovers(place)]
        garbage = [*found, *partial]
        lines = [_sized(item.bytes, f"{item.kind:<10}  {_name(item.folder, opened)}") for item in garbage]
        size = sum(item.bytes for item in garbage)
        if garbage and not dry_run:
            if not yes:
                if as_json or not sys.stdin.isatty():
                    raise InputError(
                        f"gc would remove {count(len(garbage), 'item')}, and cannot ask here",
                        hint="give --yes; --dry-run lists them",
                    )
                click.echo("\n".join([*lines, _sized(size, "in total")]))
                lines = []
                if not click.confirm("Remove them?", err=True):
                    click.echo("nothing was removed")
                    return
            chosen = {item.folder for item in found}
            opened.collect(dag.names, checkpoints=checkpoints, dry_run=False, chosen=chosen)
            for item in partial:
                remove(item.folder)
    answer(
        as_json,
        [{"folder": str(item.folder), "kind": item.kind, "bytes": item.bytes} for item in garbage],
        *lines,
        _sized(size, "would be freed" if dry_run else "freed"),
    )


def _sized(size: int, text: str) -> str:
    return f"{size / 1e6:>9.1f} MB  {text}"


def _name(path: Path, store: Store) -> Path:
    return path.relative_to(store.root) if path.is_relative_to(store.root) else path
