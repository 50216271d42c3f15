"""What a report was made from, and what the last run did: ``report.json`` beside the page."""

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


@dataclass(frozen=True)
class LastRun:
    """What the last ``cleargs run`` did, which no manifest says."""

    stages: Mapping[str, str]
    """Stage -> made or found."""
    peak_memory_gb: float


def page_of(run: Path) -> Path:
    """Where the report of ``run`` is, or would be."""
    return run / FOLDER / PAGE


def linked_manifests(run: Path, names: Sequence[str]) -> dict[str, Manifest]:
    """The manifests that the run shows now, in the order of the stages."""
    found = {name: linked_manifest(run, name) for name in names}
    return {name: manifest for name, manifest in found.items() if manifest is not None}


def is_current(run: Path, manifests: Mapping[str, Manifest]) -> bool:
    """Whether the report of ``run`` is of these results and of this version."""
    return (run / FOLDER / PAGE).is_file() and _read_report(run).get("made_from") == _made_from(manifests)


def _made_from(manifests: Mapping[str, Manifest]) -> dict[str, str]:
    return {"cleargs": cleargs.__version__, **{name: manifest.key for name, manifest in manifests.items()}}


def _read_report(run: Path) -> dict[str, Any]:
    try:
        record = read_json(run / FOLDER / REPORT_JSON)
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def last_run(run: Path) -> LastRun | None:
    """What the present report knows of the last run; None without it."""
    try:
        return LastRun(**_read_report(run)["last_run"])
    except (KeyError, TypeError):
        return None


def write_report_json(folder: Path, manifests: Mapping[str, Manifest], last: LastRun | None) -> None:
    """Note in the report's ``folder`` what it is made from."""
    note = {"made_from": _made_from(manifests), "last_run": asdict(last) if last else None}
    write_json(folder / REPORT_JSON, note)
