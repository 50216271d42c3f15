"""Install a model from its PyTorch checkpoint, or convert any restorer that spandrel reads.

Run it in the environment of ``make convert-env``::

    .venv-convert/bin/python -m tools.convert_models restormer-motion motion_deblurring.pth --accept-licence
    .venv-convert/bin/python -m tools.convert_models mine.onnx FILE.pth
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import click

from cleargs.errors import CleargsError, InputError
from cleargs.models.install import place, read_checked
from cleargs.models.registry import RegistryEntry, file_digest, find_model, model_dir
from cleargs.safe_io import read_bytes
from tools.convert_models import restorer, scorers
from tools.convert_models.torch_export import require

_PACKAGES = {
    "spandrel": ("spandrel", "spandrel_extra_arches", "onnxscript"),
    "musiq": ("pyiqa", "clip", "onnxscript"),
    "clip-iqa": ("pyiqa", "clip", "onnxscript"),
}
"""Packages that each converter imports."""


@click.command()
@click.argument("target", metavar="NAME|OUTPUT.onnx")
@click.argument("checkpoint", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--accept-licence", is_flag=True, help="Accept a licence that forbids commercial use.")
@click.option(
    "--dir",
    "directory",
    envvar="CLEARGS_MODELS",
    show_envvar=True,
    type=click.Path(file_okay=False, path_type=Path),
    help="The folder of installed models.  [default: in the user's cache folder]",
)
@click.option(
    "--tile",
    type=click.IntRange(64, 1024),
    default=256,
    show_default=True,
    help="Tile size of OUTPUT.onnx, px.",
)
def main(target: str, checkpoint: Path, accept_licence: bool, directory: Path | None, tile: int) -> None:
    """Install the model NAME from its published CHECKPOINT, or convert a restoration network to OUTPUT.onnx.

    Any architecture that spandrel reads can be converted. Use the file with rivr.expert=OUTPUT.onnx.
    """
    if target.endswith(".onnx"):
        require(*_PACKAGES["spandrel"], purpose=f"converting {checkpoint.name}")
        restorer.convert(read_bytes(checkpoint), Path(target), tile)
        click.echo(target)
        return
    model = find_model(target)
    click.echo(f"licence of {model.name}: {model.licence}", err=True)
    for path in install_checkpoint(
        model, directory or model_dir(), checkpoint, licence_accepted=accept_licence
    ):
        click.echo(path)


def install_checkpoint(
    model: RegistryEntry, directory: Path, checkpoint: Path, *, licence_accepted: bool = False
) -> list[Path]:
    """Convert a checkpoint and install the model.

    Args:
        model: Entry of the registry.
        directory: Folder of installed models.
        checkpoint: File from the publisher.
        licence_accepted: True if the user accepted a licence that forbids commercial use.

    Returns:
        The written files.

    Raises:
        InputError: The model needs no conversion, its licence is not accepted, the file is not the published
            one, or a package is missing.
    """
    source = model.source
    if source is None or source.spec != "file":
        raise InputError(f"{model.name} needs no conversion", hint="see `cleargs models list`")
    require(*_PACKAGES.get(model.converter or "", ()), purpose=f"converting {model.name}")
    if not source.verified:
        click.echo(
            f"warning: the publisher of {source.label} gives no full digest, so the file cannot be verified. "
            "Later checks compare with the digest of this file",
            err=True,
        )

    if not (model.commercial or licence_accepted):
        raise InputError(
            f"the licence of {model.name} forbids commercial use: {model.licence}",
            hint="to accept it, repeat the command with --accept-licence",
        )
    data = read_checked(checkpoint, source)

    def convert(folder: Path) -> None:
        path = folder / model.files[0].name
        if model.converter == "spandrel":
            restorer.convert(data, path)
        else:
            scorers.convert(model.converter or "", data, path)
        digests = {file.name: file_digest(folder / file.name) for file in model.files}
        facts = {"model": model.name, "source_sha256": hashlib.sha256(data).hexdigest(), "files": digests}
        (folder / model.receipt).write_text(json.dumps(facts, indent=2) + "\n", "utf-8")

    return place(model, directory, convert)


if __name__ == "__main__":
    try:
        main(prog_name="python -m tools.convert_models")
    except CleargsError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        sys.exit(error.exit_code)
