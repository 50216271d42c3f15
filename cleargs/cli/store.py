"""``cleargs verify`` and ``gc``: the files of a run and its store, read again or cleared away."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import click

from cleargs.cli.common import FOLDER, answer, json_option, run_argument, store_option
from cleargs.digest import named_files
from cleargs.errors import InputError
from cleargs.manifest import Manifest, damages, read_manifest
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.run_file import RunSpec, read_run_file
from cleargs.pipeline.session import opened_store
from cleargs.pipeline.store import ROOTS, Store
from cleargs.report.formatting import count


class StoreFault(NamedTuple):
    """A damaged result or a changed input."""

    kind: Literal["damaged", "changed"]
    stage: str
    what: str


@click.command(
    epilog="""\b
Example:
  cleargs verify room      before an archive is trusted, or after a disk was
"""
)
@run_argument
@store_option
@json_option
@click.pass_obj
def verify(dag: Dag, run: Path, store: Path | None, as_json: bool) -> int:
    """Read every file that RUN shows, and every input that it was made from, and compare them with the
    digests in its manifests.

    Other commands trust a file whose size and time stamps did not change. Damaged results are made again by
    the next `cleargs run`. Exit code 1 when something is damaged or changed.
    """
    settings = read_run_file(run, dag, store=store)
    faults: list[StoreFault] = []
    stages: list[str] = []
    files = 0
    with opened_store(settings.store) as opened:
        for name in dag.names:
            folder = settings.folder / name
            if not folder.is_symlink() and not folder.exists():
                continue  # not made yet; a copy of a run has folders in place of links
            stages.append(name)
            try:
                manifest = read_manifest(folder)
            except (OSError, ValueError) as error:
                text = "it is no longer in the store" if isinstance(error, OSError) else str(error)
                faults.append(StoreFault("damaged", name, text))
                continue
            files += len(manifest.files)
            place = folder.resolve()
            lines = damages(place, manifest, manifest.files, opened.memo, rehash=True)
            faults += [StoreFault("damaged", name, line) for line in lines]
            faults += _changed_inputs(dag, settings, opened, manifest)
    if not stages:
        raise InputError(f"{run} has no results yet", hint=f"first: cleargs run {settings.source} -o {run}")
    found = count(len(faults), "fault") if faults else "all as they were made"
    answer(
        as_json,
        {"stages": stages, "files": files, "faults": [fault._asdict() for fault in faults]},
        *(f"{kind:<8} {stage:<12} {text}" for kind, stage, text in faults),
        f"{files} files of {len(stages)} stages read: {found}",
    )
    if any(fault.kind == "damaged" for fault in faults):
        click.echo(f"hint: `cleargs run {settings.source} -o {run}` makes damaged results again", err=True)
    return 1 if faults else 0


def _changed_inputs(dag: Dag, run: RunSpec, store: Store, manifest: Manifest) -> Iterator[StoreFault]:
    """What differs between the files outside the store that a stage was made from, and those there now."""
    stage = manifest.stage
    for role, place in dag.load(stage).externals(run.config.sections[stage], run.source).items():
        before = manifest.origins.get(role)
        if before is None:
            continue  # the stage was made with other settings, which `cleargs status` tells
        files = named_files(place)
        for name in sorted(before.keys() | files.keys()):
            change = None
            if name not in files:
                change = " is missing"
            elif name not in before:
                change = " is new"
            else:
                try:
                    if store.memo.digests_of(files[name], rehash=True)[""] != before[name]:
                        change = " has other content"
                except InputError as error:
                    change = f": {error}"
            if change:
                yield StoreFault("changed", stage, f"{role} {name}".rstrip() + change)


@click.command(
    epilog="""\b
Examples:
  cleargs gc room --dry-run         what would go
  cleargs gc --store /data/store    a store that several runs share
"""
)
@click.argument("run", required=False, type=FOLDER)
@store_option
@click.option(
    "--checkpoints",
    is_flag=True,
    help="Remove the checkpoints of interrupted work, and what is kept about single frames, too.",
)
@click.option("--dry-run", is_flag=True, help="Only say what would be removed.")
@json_option
@click.pass_obj
def gc(
    dag: Dag, run: Path | None, store: Path | None, checkpoints: bool, dry_run: bool, as_json: bool
) -> None:
    """Remove the results that no run links to, from the store of RUN or from --store.

    A run counts as long as its folder exists where it was last used. Going back to settings whose results
    were removed makes them again.
    """
    if run is None and store is None:
        raise InputError("neither a run nor a store is named", hint="give RUN or --store DIR")
    root = store if run is None else read_run_file(run, dag, store=store).store
    assert root is not None
    if not root.is_dir():
        raise InputError(f"there is no store {root}", hint="give the folder that was passed as --store")
    if run is None and not (root / ROOTS).is_dir():  # every run that uses a store is noted there
        raise InputError(
            f"{root} is no store", hint="give the folder that was passed as --store, or RUN without --store"
        )
    with opened_store(root) as opened:
        if run is not None and not dry_run:
            opened.add_root(run.absolute())
        garbage = opened.collect(dag.names, checkpoints=checkpoints, dry_run=dry_run)
    sized = [(item.bytes, f"{item.kind:<10}  {item.folder.relative_to(opened.root)}") for item in garbage]
    sized.append((sum(item.bytes for item in garbage), "would be freed" if dry_run else "freed"))
    answer(
        as_json,
        [{"folder": str(item.folder), "kind": item.kind, "bytes": item.bytes} for item in garbage],
        *(f"{size / 1e6:>9.1f} MB  {text}" for size, text in sized),
    )
