"""``RUN/run.toml``: the input, the full resolved configuration, and where the results are stored."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from textwrap import wrap

import tomli_w

from cleargs.errors import ConfigError, InputError
from cleargs.files import disk_errors, write_bytes
from cleargs.pipeline.config import Config, Document, check_document, read_toml
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.stage import Device as Device
from cleargs.pipeline.store import STORE_FOLDER

RUN_FILE = "run.toml"

LOCK = ".lock"
"""Held by the process that works in the run folder."""

HEADER = """\
# The full configuration of this run, as `cleargs run` resolved it: all commands on the run read it, and the
# settings stay until `cleargs run` is told others (--set, --workflow, or --reset to start from the recipe).
"""

WIDTH = 110
"""Of the comments, characters."""


@dataclass(frozen=True)
class RunSpec:
    """A run folder and all that decides its results."""

    folder: Path
    """Absolute."""
    source: Path
    """The capture as the user gave it, absolute."""
    config: Config
    store: Path
    """Absolute."""
    device: Device


def write_run_file(run: RunSpec) -> None:
    """Create the run folder and write its ``run.toml``. Raises StoreError when that is not allowed."""
    document: Document = {"input": str(run.source), "device": run.device}
    if run.store != run.folder / STORE_FOLDER:
        document["store"] = str(run.store)
    document["seed"] = run.config.seed
    path, text = run.folder / RUN_FILE, (HEADER + tomli_w.dumps(document) + _commented(run.config)).encode()
    with disk_errors(path):
        run.folder.mkdir(parents=True, exist_ok=True)
        if not path.is_file() or path.read_bytes() != text:
            write_bytes(path, text)


def _commented(config: Config) -> str:
    """All settings as TOML, each below its meaning, range and default; unset ones as a comment."""
    tables: dict[str, list[str]] = {}
    for setting, value in config.settings():
        table, _, field = setting.name.rpartition(".")
        lines = tables.setdefault(table, [])
        facts = "; ".join(filter(None, (setting.allowed, f"default {setting.default_text}")))
        comment = f"{setting.meaning} ({facts})" if setting.meaning else facts
        lines += wrap(comment, WIDTH, initial_indent="# ", subsequent_indent="# ")
        if value is None:
            lines.append(f"# {field} =")
        elif isinstance(value, list):  # tomli_w spreads lists over lines
            items = (tomli_w.dumps({"_": item}).partition("=")[2].strip() for item in value)
            lines.append(f"{field} = [{', '.join(items)}]")
        else:
            lines.append(tomli_w.dumps({field: value}).rstrip())
    return "".join(f"\n[{table}]\n" + "\n".join(lines) + "\n" for table, lines in tables.items())


@dataclass(frozen=True)
class RunMetadata:
    """Content of the ``run.toml`` of an earlier call; None for what it does not say or says wrongly."""

    settings: Document = field(default_factory=dict)
    """Unchecked."""
    source: Path | None = None
    store: Path | None = None
    device: Device | None = None
    damaged: bool = False
    """True when it says one of the three wrongly."""


def read_metadata(folder: Path) -> RunMetadata:
    """Return what `write_run_file` noted in ``folder``; nothing when there is no run.

    Each of input, store and device is read on its own: a damaged one hides no other. Raises ConfigError when
    the file is no TOML.
    """
    if not (folder / RUN_FILE).is_file():
        return RunMetadata()
    document = read_toml(folder / RUN_FILE)
    given = {name: document.pop(name, None) for name in ("input", "store", "device")}
    paths = {
        name: Path(value)
        for name, value in given.items()
        if name != "device" and isinstance(value, str) and value and "\0" not in value
    }
    device = given["device"] if given["device"] in ("cpu", "cuda") else None
    read = {*paths, *(["device"] if device else [])}
    damaged = any(value not in (None, "") and name not in read for name, value in given.items())
    return RunMetadata(document, paths.get("input"), paths.get("store"), device, damaged)


def read_source(folder: Path) -> Path | None:
    """Return the capture that the run in ``folder`` was made from; None where none can be read."""
    try:
        return read_metadata(folder).source
    except ConfigError:
        return None


def read_run_file(
    folder: Path, dag: Dag, *, store: Path | None = None, device: Device | None = None
) -> RunSpec:
    """The run that `write_run_file` noted in ``folder``; ``store`` and ``device`` override what it says.

    Raises InputError when there is no run, ConfigError when its file is damaged.
    """
    folder = folder.absolute()
    if not (folder / RUN_FILE).is_file():
        raise InputError(
            f"{folder} is no run: it has no {RUN_FILE}", hint=f"start one: cleargs run INPUT -o {folder}"
        )
    metadata = read_metadata(folder)
    if metadata.source is None or metadata.damaged:
        raise damaged_run_file(folder)
    config = check_document(dag, metadata.settings)
    place = store or metadata.store or folder / STORE_FOLDER
    return RunSpec(folder, metadata.source, config, place, device or metadata.device or "cpu")


def damaged_run_file(folder: Path) -> ConfigError:
    """Return the error for a ``run.toml`` whose input, store or device cannot be used."""
    return ConfigError(f"{folder / RUN_FILE} is damaged", hint="call `cleargs run` with its input again")
