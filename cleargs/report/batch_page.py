"""``BATCH/report/index.html``: all scenes of a batch as a grid that leads to their own reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from shlex import quote as quoted
from typing import Any
from urllib.parse import quote

from cleargs.batch.folder import BatchFolder, Plan
from cleargs.batch.status import SceneState
from cleargs.capture.tables import load_frames
from cleargs.errors import CleargsError
from cleargs.manifest import Manifest
from cleargs.media.image import read_rgb
from cleargs.report.frame_pictures import Picture, side_of, write_jpeg
from cleargs.report.frame_strip import last_scene
from cleargs.report.html import new_report, write_page
from cleargs.report.report_json import FOLDER, is_current, linked_manifests, page_of
from cleargs.report.verdict import training_psnr
from cleargs.report.words import count, decibel, duration, size
from cleargs.splat.ply import ply_size

BYTES = 15_000_000
"""About how much all thumbnails together may take."""

ORDER = ("failed", "partial", "running", "waiting", "done")
"""Of the scenes: what needs a look comes first."""

_MAX_SIDE, _MIN_SIDE = 480, 96  # px, of a thumbnail
_FOLDER = "scenes"
_ASPECT = 9 / 16  # of most captures


@dataclass(frozen=True)
class Card:
    """One scene."""

    state: SceneState
    stages: int
    """That are wanted."""
    picture: Picture | None
    shows: str
    """What the picture is of."""
    figures: Sequence[tuple[str, str]]
    """Value and what it is."""
    report: str
    """Address of its report; "" without one."""
    note: str
    """What to know of its report."""
    log: str
    """Address of the log of a stage that failed."""
    seconds: float
    """Of work, all stages."""
    bytes: int
    """Of results."""


def write_batch(folder: BatchFolder, plan: Plan, states: Sequence[SceneState]) -> Path:
    """Write the report of a batch, in place of an older one; returns its page.

    Raises StoreError when it cannot be written.
    """
    ordered = sorted(states, key=lambda state: ORDER.index(state.state))
    side = min(_MAX_SIDE, side_of(len(states), _ASPECT, BYTES, _MIN_SIDE))
    kinds: Counter[str] = Counter(state.state for state in states)
    with new_report(folder.root) as report:
        (report / _FOLDER).mkdir()
        cards = [_card(folder, plan, state, report, place, side) for place, state in enumerate(ordered)]
        write_page(
            report,
            "batch.html.jinja",
            name=folder.root.name,
            aspect=None,
            tone="poor" if kinds["failed"] else "good" if kinds["done"] == len(states) else "fair",
            scenes=count(len(states), "scene"),
            kinds=[(kind, kinds[kind]) for kind in ORDER if kinds[kind]],
            done=kinds["done"],
            total=duration(sum(card.seconds for card in cards)),
            bytes=size(sum(card.bytes for card in cards)),
            until=plan.until,
            cards=cards,
        )
    return page_of(folder.root)


def _card(
    folder: BatchFolder,
    plan: Plan,
    state: SceneState,
    report: Path,
    place: int,
    side: int,
) -> Card:
    run = folder.run(state.scene)
    made = linked_manifests(run, list(plan.stages))
    picture, shows = _picture(run, made, report, f"{_FOLDER}/{place:05d}.jpg", side)
    page = page_of(run)
    note = ""
    if not page.is_file():
        beside = quoted(str(run.relative_to(folder.root.parent)))
        note = f"No report yet: cleargs report {beside}" if "ingest" in made else ""
    elif not is_current(run, made):
        note = "The report is older than the results."
    return Card(
        state=state,
        stages=len(plan.wanted),
        picture=picture,
        shows=shows,
        figures=_figures(run, made),
        report=_address(folder, page) if page.is_file() else "",
        note=note,
        log=_address(folder, state.log) if state.log is not None and state.log.is_file() else "",
        seconds=sum(manifest.seconds for manifest in made.values()),
        bytes=sum(manifest.bytes for manifest in made.values()),
    )


def _picture(
    run: Path, made: Mapping[str, Manifest], report: Path, name: str, side: int
) -> tuple[Picture | None, str]:
    """A picture of the scene as far as it is: the still of its report, else its first frame."""
    still = run / FOLDER / "after.jpg"
    try:
        if still.is_file():
            return write_jpeg(report, name, read_rgb(still), side), "the scene"
        if "ingest" in made:
            frames = load_frames(run / "ingest")
            return write_jpeg(
                report, name, read_rgb(run / "ingest" / frames[0].image), side
            ), "the first frame"
    except CleargsError:  # a damaged picture is no reason to leave out the scene
        pass
    return None, ""


def _figures(run: Path, made: Mapping[str, Manifest]) -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = []
    ingest: Mapping[str, Any] = made["ingest"].summary if "ingest" in made else {}
    if "registered" in ingest:
        found.append((f"{ingest['registered']} of {ingest['frames']}", "frames placed"))
    if (scene := last_scene(made)) is not None:
        with suppress(CleargsError, OSError):  # a damaged scene has no size
            found.append((f"{ply_size(run / scene / 'scene.ply')[0]:,}", "Gaussians"))
    if (psnr := training_psnr(made)[0]) is not None:
        found.append((decibel(psnr), "PSNR of the first scene on training poses"))
    if made:
        found.append((duration(sum(manifest.seconds for manifest in made.values())), "of work"))
    return found


def _address(folder: BatchFolder, path: Path) -> str:
    """Of a file of the batch, as the page's links take it."""
    return f"../{quote(path.relative_to(folder.root).as_posix())}"
