"""``report.json``, next to the page: the results that the report shows."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import cleargs
from cleargs.capture.summary import IngestSummary
from cleargs.errors import StoreError, listed
from cleargs.files import remove, write_json
from cleargs.manifest import Manifest, linked_manifest
from cleargs.own_files import leftovers, refuse_links, regular_files
from cleargs.safe_io import FAULTS, read_bytes, read_json

FOLDER, PAGE, REPORT_JSON = "report", "index.html", "report.json"
ENTRY = "report.html"
"""File in the run folder that leads to the report."""

_OURS = re.compile(
    r"index\.html|report\.json|(viewer|scene)\.js|scene\.jpg|viewer-LICENSE\.txt"
    r"|frames/\d+(-[a-z]+)?\.jpg|scenes/[^/]+\.jpg"
)
"""Files of a report, relative to its folder."""

_GENERATOR = b'"generator" content="ClearGS '
"""Mark in the head of the pages."""


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
        made_from = read_json(run / FOLDER / REPORT_JSON, root=run)["made_from"]
        return page_of(run).is_file() and _made_from(manifests) == made_from
    return False


def is_own_page(page: Path) -> bool:
    """Return True if the HTML file ``page`` is a report. Raises OSError if it cannot be read."""
    return _GENERATOR in read_bytes(page)[:4096]


def require_own(run: Path) -> None:
    """Raise StoreError if the report of a run or batch would replace what is not a report of ClearGS.

    Partial reports of processes that died are deleted.
    """
    folder, entry = run / FOLDER, run / ENTRY
    refuse_links([folder, entry])
    names = [file.relative_to(folder).as_posix() for file in regular_files(folder)]
    others = [f"{folder}/{name}" for name in names if not _OURS.fullmatch(name) or PAGE not in names]
    for page, mark in ((folder / PAGE, _GENERATOR), (entry, b"url=report/index.html")):
        noted = page != entry and REPORT_JSON in names
        if page.exists() and not noted and mark not in read_bytes(page, root=run)[:4096]:
            others.append(str(page))
    if others or folder.is_file():
        raise StoreError(
            f"{listed(others or [str(folder)])}: not made by ClearGS, and in the place of the report",
            hint="move it to another folder",
        )
    for name in (FOLDER, f"{FOLDER}.old"):
        for leftover in leftovers(run, name):
            remove(leftover)


def _made_from(manifests: Mapping[str, Manifest]) -> dict[str, str]:
    return {"cleargs": cleargs.__version__, **{name: manifest.key for name, manifest in manifests.items()}}


def write_report_json(folder: Path, manifests: Mapping[str, Manifest]) -> None:
    write_json(folder / REPORT_JSON, {"made_from": _made_from(manifests), "cameras": cameras_of(manifests)})


def cameras_of(manifests: Mapping[str, Manifest]) -> dict[str, Any]:
    """Return how the cameras were placed, by ingest's manifest; empty without one.

    ``method`` is "given", "adjusted", "sfm over given" (SfM, aligned to the given cameras) or "sfm".
    ``off_px_before`` and ``off_px`` are the median errors (px) of matches that the fit did not use, at the
    given poses and at those of the method; None if not measured. ``kept_out`` has the figure of all keypoints
    that no fit used.
    ``lenses`` has lens, focal length and number
    of frames of each camera. ``placed`` has the number of frames by the way in which they were placed.
    """
    if (ingest := manifests.get("ingest")) is None:
        return {}
    found = IngestSummary.of(ingest)
    errors, origin = found.kept_out_matches_off_px or {}, found.poses or "sfm"
    return {
        "method": "sfm over given" if origin == "sfm" and errors else origin,
        "off_px_before": errors.get("given"),
        "off_px": errors.get(origin),
        "kept_out": found.kept_out,
        "lenses": found.cameras,
        "placed": found.placed,
    }
