"""The tables of RIVR and consolidation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pyarrow as pa

from cleargs.parquet import column, read_table, write_table
from cleargs.rivr.candidates import Chosen, Source


def _scores(role: str, use: str) -> list[pa.Field]:
    meaning = f"{role} score, 0-100, higher is better, of"
    return [
        column(f"{role}_metric", pa.string(), f"name of the scorer that {use}"),
        column(f"{role}_render", pa.float32(), f"{meaning} the render R_t"),
        column(f"{role}_restored", pa.float32(), f"{meaning} the restored observation D_t"),
        column(f"{role}_fused", pa.float32(), f"{meaning} the fusion F_t; null without it", nullable=True),
        column(
            f"{role}_observed",
            pa.float32(),
            f"{meaning} the raw frame O_t; null with rivr.keep_raw=false",
            nullable=True,
        ),
    ]


SELECTION = pa.schema(
    [
        column("round", pa.int32(), "from 1"),
        column("frame_id", pa.int32(), "target frame t"),
        column(
            "exr",
            pa.string(),
            "layers render, restored, fused, observed, deblurred, explained; below the rivr folder",
        ),
        *_scores("primary", "decides"),
        *_scores("tiebreak", "decides among the candidates within rivr.margin of the best primary score"),
        column(
            "restored_from", pa.string(), "what the expert restored to D_t: observation, deblurred or render"
        ),
        column("blur_px", pa.float32(), "mean way of the pixels while exposed, as undone", nullable=True),
        column("skew_px", pa.float32(), "their mean way from the first to the last row", nullable=True),
        column("chosen", pa.string(), "render, restored or fused; observed: the raw frame needs no repair"),
        column("accepted", pa.bool_(), "whether the chosen candidate became a pseudo observation"),
        column("reason", pa.string(), "why it was chosen, or why there is no pseudo observation"),
    ]
)

REPAIRS = pa.schema(
    [
        column("frame_id", pa.int32(), "frame with an accepted repair"),
        column("round", pa.int32(), "its latest accepted round, from 1"),
        column("exr", pa.string(), "layered EXR, relative to the rivr folder"),
        column("chosen", pa.string(), "layer that supervises: render, restored or fused"),
    ]
)


@dataclass(frozen=True)
class Selection:
    """One row of ``rivr/selection.parquet``. Scores are float32 values, as the EXR holds them."""

    round: int
    frame_id: int
    exr: str
    primary_metric: str
    primary_render: float
    primary_restored: float
    primary_fused: float | None
    primary_observed: float | None
    tiebreak_metric: str
    tiebreak_render: float
    tiebreak_restored: float
    tiebreak_fused: float | None
    tiebreak_observed: float | None
    restored_from: Source
    blur_px: float | None
    skew_px: float | None
    chosen: Chosen
    accepted: bool
    reason: str


def write_selection(path: Path, rows: list[Selection]) -> None:
    """Write the rows in their order."""
    write_table(path, pa.Table.from_pylist([asdict(row) for row in rows], SELECTION), SELECTION)


def read_selection(path: Path) -> list[Selection]:
    """Read the rows in their order. Raises StoreError."""
    return [Selection(**row) for row in read_table(path, SELECTION).to_pylist()]


def latest_accepted(rows: Sequence[Selection]) -> list[Selection]:
    """The accepted row of the latest round of every frame that has one and is not kept raw, by frame_id."""
    kept = kept_raw(rows)
    latest = {row.frame_id: row for row in sorted(rows, key=lambda row: row.round) if row.accepted}
    return [latest[frame_id] for frame_id in sorted(latest.keys() - kept)]


def kept_raw(rows: Sequence[Selection]) -> set[int]:
    """The frames whose latest row says that they need no repair.

    The latest scene is the best judge, so this takes back an earlier repair, as a later repair does.
    """
    latest = {row.frame_id: row for row in sorted(rows, key=lambda row: row.round)}
    return {frame_id for frame_id, row in latest.items() if row.chosen == "observed"}


def repaired_share(rows: Sequence[Selection]) -> float:
    """Of the frames that have a repair or are kept raw, the share of the former; 0 without either."""
    repaired, kept = len(latest_accepted(rows)), len(kept_raw(rows))
    return repaired / max(repaired + kept, 1)


def write_repairs(path: Path, repairs: list[Selection]) -> None:
    """Write ``consolidate/repairs.parquet``."""
    columns = [{name: getattr(row, name) for name in REPAIRS.names} for row in repairs]
    write_table(path, pa.Table.from_pylist(columns, REPAIRS), REPAIRS)
