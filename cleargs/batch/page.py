"""``BATCH/report/index.html``: a grid of all scenes with links to their reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args
from urllib.parse import quote

from rich.filesize import decimal

from cleargs.batch.loop import Batch
from cleargs.batch.sheet import SceneJob
from cleargs.batch.summary import Result, State
from cleargs.capture.tables import load_frames
from cleargs.errors import CleargsError
from cleargs.files import whole_folder
from cleargs.manifest import Manifest
from cleargs.media.image import read_rgb
from cleargs.report.formatting import count, duration
from cleargs.report.html import page_html
from cleargs.report.pictures import ImageFile, side_of, write_jpeg
from cleargs.report.report_json import FOLDER, PAGE, is_current, linked_manifests, page_of, require_own

BYTES = 15_000_000
"""Approximate limit for the size of all thumbnails together."""

MAX_SIDE, MIN_SIDE = 480, 96
"""Limits for the long side of a thumbnail, px."""

ASPECT = 9 / 16
"""Aspect ratio of most captures, height / width."""


def write_batch(batch: Batch, results: Sequence[Result]) -> Path:
    """Write the page, and replace an older one. Return its path. Raises StoreError."""
    kinds: Counter[str] = Counter(result.state for result in results)
    order = get_args(State)
    pairs = sorted(zip(batch.scenes, results, strict=True), key=lambda pair: order.index(pair[1].state))
    require_own(batch.folder)
    side = min(MAX_SIDE, side_of(len(results), ASPECT, BYTES, MIN_SIDE))
    with whole_folder(batch.folder / FOLDER, replace=True) as report:
        (report / "scenes").mkdir()
        html = page_html(
            "batch.html.jinja",
            name=batch.folder.name,
            aspect=None,
            tone="poor" if kinds["failed"] else "good" if kinds["done"] == len(results) else "fair",
            scenes=count(len(results), "scene"),
            kinds=[(kind, kinds[kind]) for kind in order if kinds[kind]],
            done=kinds["done"],
            total=duration(60 * sum(result.minutes for result in results)),
            bytes=decimal(round(1e9 * sum(result.disk_gb for result in results))),
            stages=batch.dag.until(batch.until),
            cards=[_card(batch, scene, result, report, side) for scene, result in pairs],
        )
        (report / PAGE).write_bytes(html)
    return page_of(batch.folder)


def _card(batch: Batch, scene: SceneJob, result: Result, report: Path, side: int) -> dict[str, Any]:
    """Return the values of one scene for the template. An address is "" if there is no such file."""
    run = batch.run_folder(scene)
    made = linked_manifests(run, batch.dag.names)
    picture, shows = _picture(run, made, report, f"scenes/{scene.name}.jpg", side)
    return {
        "result": result,
        "done": list(made),
        "picture": picture,
        "shows": shows,
        "figures": result.figures(),
        "report": _address(batch, page_of(run)),
        "is_current": is_current(run, made),
        "log": _address(batch, batch.log(scene)),
    }


def _picture(
    run: Path, made: Mapping[str, Manifest], report: Path, name: str, side: int
) -> tuple[ImageFile | None, str]:
    """Write the still of the scene's report, or else the first frame. Return the file and a label for it."""
    still = run / FOLDER / "scene.jpg"
    with suppress(CleargsError):  # a damaged picture must not hide the scene
        if still.is_file():
            return write_jpeg(report, name, read_rgb(still), side), "the scene"
        if "ingest" in made:
            first = load_frames(run / "ingest")[0].image
            return write_jpeg(report, name, read_rgb(run / "ingest" / first), side), "the first frame"
    return None, ""


def _address(batch: Batch, path: Path) -> str:
    return f"../{quote(path.relative_to(batch.folder).as_posix())}" if path.is_file() else ""
