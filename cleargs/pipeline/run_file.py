"""``RUN/run.toml``: the input, the full configuration, and the place of the store."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from textwrap import wrap

import tomli_w

from cleargs.errors import ConfigError, InputError, StoreError
from cleargs.files import disk_errors, write_bytes
from cleargs.named_views import VIEWS
from cleargs.own_files import nodes_below, refuse_links
from cleargs.pipeline.config import Config, Document, check_document, known_settings, read_toml
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import ROOTS, STORE_FOLDER, copied_key
from cleargs.types import Device

RUN_FILE = "run.toml"

SCENE = "scene.ply"
"""File of the scene in the results of a stage that trains, and link to the last of them in the run folder."""

EVAL = "eval"
"""Folder in a run with the results of ``cleargs eval``."""

RUN_LOG = "run.log"
"""File in a run with the messages of all calls."""

LOCK = ".lock"
"""Lock file of the process that works in the run folder."""

PROGRESS_FILE = ".at_work.json"
"""File with the progress of the running stage. It stays if the stage stops before its end."""

OWN_NAMES = (RUN_FILE, LOCK, RUN_LOG, EVAL, PROGRESS_FILE, VIEWS, "report", "report.html")
"""Files and folders in a run that ClearGS reads or writes, apart from those of the stages."""

HEADER = """\
# The full configuration of this run. All commands on the run read it. `cleargs run` keeps these settings
# until you change them: --set and --recipe give others, --reset starts from the recipe.
"""

WIDTH = 110
"""Maximum width of a comment, in characters."""


@dataclass(frozen=True)
class RunSpec:
    """A run folder and everything that decides its results."""

    folder: Path
    """Absolute path of the run folder."""
    source: Path
    """Absolute path of the capture."""
    config: Config
    store: Path
    """Absolute path of the store."""
    device: Device

    def stages(self, dag: Stages) -> tuple[str, ...]:
        """Return the stages that have work with the settings of the run."""
        idle = {name: getattr(dag.load(name), "idle", None) for name in dag.names}
        return tuple(name for name, check in idle.items() if not (check and check(self.config.effective)))


def write_run_file(run: RunSpec) -> None:
    """Create the run folder and write its ``run.toml``. Raises StoreError if that is impossible."""
    document: Document = {"input": str(run.source), "device": run.device}
    if run.store != run.folder / STORE_FOLDER:
        document["store"] = str(run.store)
    document["seed"] = run.config.seed
    path = run.folder / RUN_FILE
    text = (HEADER + tomli_w.dumps(document) + _settings_toml(run.config)).encode()
    with disk_errors(path):
        run.folder.mkdir(parents=True, exist_ok=True)
        if not path.is_file() or path.read_bytes() != text:
            write_bytes(path, text)


def _settings_toml(config: Config) -> str:
    """Return all settings as TOML, each below its meaning, range and default. Unset ones are comments."""
    tables: dict[str, list[str]] = {}
    for setting, value in config.settings():
        table, _, field = setting.name.rpartition(".")
        lines = tables.setdefault(table, [])
        facts = "; ".join(filter(None, (setting.allowed, f"default {setting.default_text}")))
        comment = f"{setting.meaning} ({facts})" if setting.meaning else facts
        lines += wrap(comment, WIDTH, initial_indent="# ", subsequent_indent="# ")
        if value is None:
            lines.append(f"# {field} =")
        elif isinstance(value, list):  # tomli_w writes one line per item
            items = (tomli_w.dumps({"_": item}).partition("=")[2].strip() for item in value)
            lines.append(f"{field} = [{', '.join(items)}]")
        else:
            lines.append(tomli_w.dumps({field: value}).rstrip())
    return "".join(f"\n[{table}]\n" + "\n".join(lines) + "\n" for table, lines in tables.items())


def check_links(folder: Path) -> None:
    """Raise StoreError if a file or folder of the run is a link, or if a folder in ``eval`` is one.

    The links to results are not checked here, but when they are used (`cleargs.manifest.has_results`).
    """
    refuse_links(folder / name for name in OWN_NAMES)
    refuse_links(Path(node.path) for node in nodes_below(folder / EVAL) if node.is_dir())


def checked_store(run: Path, store: Path) -> Path:
    """Return ``store``. Raise StoreError if it is below ``run`` and behind a link there."""
    refuse_links([place for place in (store, *store.parents) if run in place.parents])
    return store


@dataclass(frozen=True)
class RunMetadata:
    """Content of an existing ``run.toml``; None for an entry that is missing or invalid."""

    settings: Document = field(default_factory=dict)
    """The settings, unchecked."""
    source: Path | None = None
    store: Path | None = None
    device: Device | None = None
    damaged: bool = False
    """True if input, store or device is invalid."""


def read_metadata(folder: Path) -> RunMetadata:
    """Return the content of ``run.toml`` in ``folder``, or empty metadata if there is none.

    An invalid input, store or device does not hide the others. Raises ConfigError if the file is not
    valid TOML, and StoreError like `check_links`.
    """
    if not (folder / RUN_FILE).is_file():
        return RunMetadata()
    check_links(folder)
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


def require_store(folder: Path, metadata: RunMetadata) -> None:
    """Raise StoreError if results of the run in ``folder`` were in a store that is gone, as its disk may be.

    Otherwise all stages would run again, into the empty folder where the disk was. A stage that stopped
    before its end had a checkpoint there.
    """
    store = metadata.store
    if store is None or (store / ROOTS).is_dir():
        return
    for path in folder.iterdir():
        key = copied_key(path)
        lost = (path.is_symlink() and not path.exists()) or (key and not (store / path.name / key).exists())
        if lost or path.name == PROGRESS_FILE:
            raise StoreError(
                f"the store {store} of the run {folder} is gone",
                hint="connect its disk; to begin again in another one: cleargs run INPUT -o RUN --store X",
            )


def known_metadata(folder: Path) -> RunMetadata:
    """Return the content of ``run.toml`` as `read_metadata` does, or empty metadata if it is not TOML."""
    try:
        return read_metadata(folder)
    except ConfigError:
        return RunMetadata()


def located(folder: Path) -> Path:
    """Return the absolute path of a run folder, which has a name: ``..`` is followed, and links are kept."""
    return folder.resolve() if ".." in folder.parts else folder.absolute()


def read_run_file(
    folder: Path, dag: Stages, *, store: Path | None = None, device: Device | None = None
) -> RunSpec:
    """Read the run in ``folder``. ``store`` and ``device`` replace those in ``run.toml``.

    Raises InputError if the folder has no ``run.toml``, and ConfigError if the file is damaged.
    """
    folder = located(folder)
    if not (folder / RUN_FILE).is_file():
        raise InputError(
            f"{folder} is not a run: it has no {RUN_FILE}", hint=f"start one: cleargs run INPUT -o {folder}"
        )
    metadata = read_metadata(folder)
    if metadata.source is None or metadata.damaged:
        raise damaged_run_file(folder)
    settings, _ = known_settings(dag, metadata.settings)
    config = check_document(dag, settings)
    place = store or metadata.store or folder / STORE_FOLDER
    if place == metadata.store:
        require_store(folder, metadata)
    place = checked_store(folder, place)
    return RunSpec(folder, metadata.source, config, place, device or metadata.device or "cpu")


def damaged_run_file(folder: Path) -> ConfigError:
    """Return the error for a ``run.toml`` with an invalid input, store or device."""
    return ConfigError(f"{folder / RUN_FILE} is damaged", hint="call `cleargs run` again with its input")
