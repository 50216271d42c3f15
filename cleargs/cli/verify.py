"""``cleargs verify``: every file of a run read again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import click

from cleargs.cli.common import json_option, print_json, run_argument, store_option
from cleargs.digest import named_files
from cleargs.errors import InputError
from cleargs.manifest import Manifest, damages, read_manifest
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.run_file import Run, read_run_file
from cleargs.pipeline.session import opened_store
from cleargs.pipeline.store import Store


class Fault(NamedTuple):
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
    faults: list[Fault] = []
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
                faults.append(Fault("damaged", name, text))
                continue
            files += len(manifest.files)
            place = folder.resolve()
            lines = damages(place, manifest, manifest.files, opened.memo, afresh=True)
            faults += [Fault("damaged", name, line) for line in lines]
            faults += _changed_inputs(dag, settings, opened, manifest)
    if not stages:
        raise InputError(f"{run} has no results yet", hint=f"first: cleargs run {settings.source} -o {run}")
    if as_json:
        print_json({"stages": stages, "files": files, "faults": [fault._asdict() for fault in faults]})
    else:
        for kind, stage, text in faults:
            click.echo(f"{kind:<8} {stage:<12} {text}")
        found = {0: "all as they were made", 1: "1 fault"}.get(len(faults), f"{len(faults)} faults")
        click.echo(f"{files} files of {len(stages)} stages read: {found}")
    if any(fault.kind == "damaged" for fault in faults):
        click.echo(f"hint: `cleargs run {settings.source} -o {run}` makes damaged results again", err=True)
    return 1 if faults else 0


def _changed_inputs(dag: Dag, run: Run, store: Store, manifest: Manifest) -> Iterator[Fault]:
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
                    if store.memo.digests_of(files[name], afresh=True)[""] != before[name]:
                        change = " has other content"
                except InputError as error:
                    change = f": {error}"
            if change:
                yield Fault("changed", stage, f"{role} {name}".rstrip() + change)
