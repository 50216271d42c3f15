"""``report.json``, next to the page: the results that the report shows, and the work of the last run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cleargs
from cleargs.files import write_json
from cleargs.manifest import Manifest, linked_manifest
from cleargs.safe_io import read_json

FOLDER, PAGE, REPORT_JSON = "report", "index.html", "report.json"
ENTRY = "report.html"
"""File in the run folder that leads to the report."""


@dataclass(frozen=True)
class LastRun:
    """The work of the last ``cleargs run``, which manifests do not record."""

    stages: Mapping[str, str]
    """Stage -> "made" if it ran, "found" if its results were up to date."""
    peak_memory_gb: float


def page_of(run: Path) -> Path:
    """Return the path of the report of ``run``, which need not exist."""
    return run / FOLDER / PAGE


def linked_manifests(run: Path, names: Sequence[str]) -> dict[str, Manifest]:
    """Return stage -> manifest for the results in the run folder, in the order of ``names``."""
    found = {name: linked_manifest(run, name) for name in names}
    return {name: manifest for name, manifest in found.items() if manifest is not None}


def is_current(run: Path, manifests: Mapping[str, Manifest]) -> bool:
    """Return True if the report of ``run`` shows the results of ``manifests`` and has this version."""
    return (run / FOLDER / PAGE).is_file() and _read_report(run).get("made_from") == _made_from(manifests)


def _made_from(manifests: Mapping[str, Manifest]) -> dict[str, str]:
    return {"cleargs": cleargs.__version__, **{name: manifest.key for name, manifest in manifests.items()}}


def _read_report(run: Path) -> dict[str, Any]:
    try:
        content = read_json(run / FOLDER / REPORT_JSON)
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def last_run(run: Path) -> LastRun | None:
    """Return the last run as recorded in the present report; None without it."""
    try:
        return LastRun(**_read_report(run)["last_run"])
    except (KeyError, TypeError):
        return None


def write_report_json(folder: Path, manifests: Mapping[str, Manifest], last: LastRun | None) -> None:
    """Write ``report.json`` into the ``folder`` of a report."""
    content = {"made_from": _made_from(manifests), "last_run": asdict(last) if last else None}
    write_json(folder / REPORT_JSON, content)
