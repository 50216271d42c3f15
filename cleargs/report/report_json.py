"""``report.json``, next to the page: the results that the report shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import cleargs
from cleargs.files import write_json
from cleargs.manifest import Manifest, linked_manifest
from cleargs.safe_io import FAULTS, read_json

FOLDER, PAGE, REPORT_JSON = "report", "index.html", "report.json"
ENTRY = "report.html"
"""File in the run folder that leads to the report."""


def page_of(run: Path) -> Path:
    """Return the path of the report of ``run``, which need not exist."""
    return run / FOLDER / PAGE


def linked_manifests(run: Path, names: Sequence[str]) -> dict[str, Manifest]:
    """Return stage -> manifest for the results in the run folder, in the order of ``names``."""
    found = {name: linked_manifest(run, name) for name in names}
    return {name: manifest for name, manifest in found.items() if manifest is not None}


def is_current(run: Path, manifests: Mapping[str, Manifest]) -> bool:
    """Return True if the report of ``run`` shows the results of ``manifests`` and has this version."""
    with suppress(*FAULTS):
        made_from = read_json(run / FOLDER / REPORT_JSON)["made_from"]
        return page_of(run).is_file() and _made_from(manifests) == made_from
    return False


def _made_from(manifests: Mapping[str, Manifest]) -> dict[str, str]:
    return {"cleargs": cleargs.__version__, **{name: manifest.key for name, manifest in manifests.items()}}


def write_report_json(folder: Path, manifests: Mapping[str, Manifest]) -> None:
    write_json(folder / REPORT_JSON, {"made_from": _made_from(manifests), "cameras": cameras_of(manifests)})


def cameras_of(manifests: Mapping[str, Manifest]) -> dict[str, Any]:
    """Return how the cameras were placed, by ingest's manifest; empty without one.

    ``method`` is "given", "adjusted", "sfm over given" (SfM, aligned to the given cameras) or "sfm".
    ``off_px_before`` and ``off_px`` are the median errors (px) of matches that the fit did not use, at the
    given poses and at those of the method; None if not measured. ``lenses`` has lens, focal length and number
    of frames of each camera. ``placed`` has the number of frames by the way in which they were placed.
    """
    if (ingest := manifests.get("ingest")) is None:
        return {}
    errors = ingest.summary.get("kept_out_matches_off_px") or {}
    origin = {"input": "given", "refined": "adjusted"}.get(ingest.summary.get("poses", ""), "sfm")
    return {
        "method": "sfm over given" if origin == "sfm" and errors else origin,
        "off_px_before": errors.get("given"),
        "off_px": errors.get(origin),
        "lenses": ingest.summary.get("cameras"),
        "placed": ingest.summary.get("placed"),
    }
