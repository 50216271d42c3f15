"""``RUN/run.toml``: the input, the full resolved configuration, and where the results are stored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import tomli_w

from cleargs.errors import ConfigError, InputError
from cleargs.files import disk_error, write_bytes
from cleargs.pipeline.config import Config, check_document, read_toml
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.store import STORE_FOLDER

RUN_FILE = "run.toml"

HEADER = """\
# The full configuration of this run, as `cleargs run` resolved it; stage, explain and show read it.
# To change a setting, call `cleargs run` again with another --workflow or --set.
"""

Device = Literal["cpu", "cuda"]


@dataclass(frozen=True)
class Run:
    """A run folder and all that decides its results."""

    folder: Path
    """Absolute."""
    source: Path
    """The capture as the user gave it, absolute."""
    config: Config
    store: Path
    """Absolute."""
    device: Device


def write_run_file(run: Run) -> None:
    """Create the run folder and write its ``run.toml``. Raises StoreError when that is not allowed."""
    document = {"input": str(run.source), "device": run.device}
    if run.store != run.folder / STORE_FOLDER:
        document["store"] = str(run.store)
    text = HEADER + tomli_w.dumps({**document, **run.config.document()})
    path = run.folder / RUN_FILE
    try:
        run.folder.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            write_bytes(path, text.encode())
    except OSError as error:
        raise disk_error(error, path) from error


def noted_source(folder: Path) -> Path | None:
    """The capture of the run in ``folder``; None when there is no run, or its file is damaged."""
    try:
        source = read_toml(folder / RUN_FILE).get("input")
    except ConfigError:
        return None
    return Path(source) if isinstance(source, str) else None


def read_run_file(folder: Path, dag: Dag, *, store: Path | None = None, device: Device | None = None) -> Run:
    """The run that `write_run_file` noted in ``folder``; ``store`` and ``device`` override what it says.

    Raises InputError when there is no run, ConfigError when its file is damaged.
    """
    folder = folder.absolute()
    if not (folder / RUN_FILE).is_file():
        raise InputError(
            f"{folder} is no run: it has no {RUN_FILE}", hint=f"start one: cleargs run INPUT -o {folder}"
        )
    document = read_toml(folder / RUN_FILE)
    source, noted_store = document.pop("input", None), document.pop("store", None)
    noted_device = document.pop("device", "cpu")
    if not isinstance(source, str) or noted_device not in ("cpu", "cuda"):
        raise InputError(f"{folder / RUN_FILE} is damaged", hint="call `cleargs run` with its input again")
    return Run(
        folder,
        Path(source),
        check_document(dag, document),
        store or (Path(noted_store) if noted_store else folder / STORE_FOLDER),
        device or cast(Device, noted_device),
    )
