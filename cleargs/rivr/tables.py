"""The tables of RIVR and consolidation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import pyarrow as pa

from cleargs.capture.folders import is_inside
from cleargs.errors import StoreError
from cleargs.media.exr import Layer, read_exr
from cleargs.parquet import read_table, schema_of, write_table
from cleargs.rivr.candidates import CANDIDATES, Chosen, Source
from cleargs.rivr.gates import REFUSED

_NAME = "name of the scorer that decides"
_SCORE = "score, 0-100, higher is better, of"
_FUSED = "the fusion F_t; null without it"
_OBSERVED = "the raw frame O_t; null with rivr.keep_raw=false"


@dataclass(frozen=True)
class Selection:
    """One row of ``rivr/selection.parquet``. Scores are float32 values, as the EXR holds them."""

    round: Annotated[int, "from 1"]
    frame_id: Annotated[int, "target frame t"]
    exr: Annotated[
        str | None,
        "layers render, restored, fused, observed, deblurred, explained; below the rivr folder; null where "
        "the frame was not tried",
    ]
    primary_metric: Annotated[str | None, _NAME]
    primary_render: Annotated[float | None, pa.float32(), f"primary {_SCORE} the render R_t"]
    primary_restored: Annotated[float | None, pa.float32(), f"primary {_SCORE} the restored observation D_t"]
    primary_fused: Annotated[float | None, pa.float32(), f"primary {_SCORE} {_FUSED}"]
    primary_observed: Annotated[float | None, pa.float32(), f"primary {_SCORE} {_OBSERVED}"]
    tiebreak_metric: Annotated[
        str | None, f"{_NAME} among the candidates within rivr.margin of the best primary score"
    ]
    tiebreak_render: Annotated[float | None, pa.float32(), f"tiebreak {_SCORE} the render R_t"]
    tiebreak_restored: Annotated[
        float | None, pa.float32(), f"tiebreak {_SCORE} the restored observation D_t"
    ]
    tiebreak_fused: Annotated[float | None, pa.float32(), f"tiebreak {_SCORE} {_FUSED}"]
    tiebreak_observed: Annotated[float | None, pa.float32(), f"tiebreak {_SCORE} {_OBSERVED}"]
    restored_from: Annotated[
        Source | None, "image that the expert restored to D_t: observation, deblurred or render"
    ]
    blur_px: Annotated[float | None, pa.float32(), "mean way of the pixels while exposed, as undone"]
    skew_px: Annotated[float | None, pa.float32(), "their mean way from the first to the last row"]
    chosen: Annotated[Chosen, "render, restored or fused; observed: the raw frame needs no repair"]
    accepted: Annotated[bool, "true if the chosen candidate became a pseudo observation"]
    reason: Annotated[str, "reason of the choice, or of the lack of a pseudo observation"]

    def layers(self, rivr: Path) -> Mapping[str, Layer]:
        """Return the layers of the frame's EXR, which is below the rivr folder.

        Raises ValueError if the frame was not tried, and StoreError if the EXR is missing or damaged.
        """
        if self.exr is None:
            raise ValueError(f"frame {self.frame_id} was not tried")
        if not is_inside(self.exr):
            raise StoreError(f"{rivr} names an EXR outside", hint="do not use this run")
        return read_exr(rivr / self.exr).layers

    @classmethod
    def not_tried(cls, frame_id: int, reason: str) -> Selection:
        """Return the row of a frame that is kept as filmed and for which no candidate was made."""
        row: dict[str, Any] = dict.fromkeys(SELECTION.names)
        row |= {"round": 1, "frame_id": frame_id, "chosen": "observed", "accepted": False, "reason": reason}
        return cls(**row)


@dataclass(frozen=True)
class Repair:
    """One row of ``consolidate/repairs.parquet``."""

    frame_id: Annotated[int, "frame with an accepted repair"]
    round: Annotated[int, "its latest accepted round, from 1"]
    exr: Annotated[str, "layered EXR, relative to the rivr folder"]
    chosen: Annotated[Chosen, "layer that supervises: render, restored or fused"]


CHOICES: tuple[Chosen, ...] = (*CANDIDATES, "observed")
"""Values of ``chosen`` in a row."""

SELECTION, REPAIRS = schema_of(Selection), schema_of(Repair)


def write_selection(path: Path, rows: list[Selection]) -> None:
    """Write the rows in their order."""
    write_table(path, pa.Table.from_pylist([asdict(row) for row in rows], SELECTION), SELECTION)


def read_selection(path: Path) -> list[Selection]:
    """Read the rows in their order. Raise StoreError if the table is missing or damaged."""
    return [Selection(**row) for row in read_table(path, SELECTION).to_pylist()]


def latest_accepted(rows: Sequence[Selection]) -> list[Selection]:
    """Return the latest accepted row of every frame that is not kept raw, by frame_id."""
    kept = kept_raw(rows)
    latest = {row.frame_id: row for row in sorted(rows, key=lambda row: row.round) if row.accepted}
    return [latest[frame_id] for frame_id in sorted(latest.keys() - kept)]


def kept_raw(rows: Sequence[Selection]) -> set[int]:
    """Return the frames whose latest row says that they need no repair.

    The latest scene is the best reference, so this revokes an earlier repair, as a later repair does.
    """
    latest = {row.frame_id: row for row in sorted(rows, key=lambda row: row.round)}
    return {frame_id for frame_id, row in latest.items() if row.chosen == "observed"}


def repaired_share(rows: Sequence[Selection]) -> float:
    """Return the share of repaired frames among those that are repaired or kept raw; 0 without either."""
    repaired, kept = len(latest_accepted(rows)), len(kept_raw(rows))
    return repaired / max(repaired + kept, 1)


def write_repairs(path: Path, repairs: list[Selection]) -> None:
    """Write ``consolidate/repairs.parquet``."""
    columns = [{name: getattr(row, name) for name in REPAIRS.names} for row in repairs]
    write_table(path, pa.Table.from_pylist(columns, REPAIRS), REPAIRS)


def round_figures(number: int, rows: Sequence[Selection]) -> dict[str, Any]:
    """Return the figures of round ``number`` for the manifest."""
    rows = [row for row in rows if row.round == number]
    tried = [row for row in rows if row.exr is not None]
    refused = [row for row in rows if not row.accepted and row.chosen != "observed"]
    means = {
        f"{role}_{name}": fmean(scores)
        for role in ("primary", "tiebreak")
        for name in CHOICES
        if (scores := [score for row in rows if (score := getattr(row, f"{role}_{name}")) is not None])
    }
    return {
        "round": number,
        "tried": len(tried),
        "chosen": chosen_counts(tried),
        "accepted": sum(row.accepted for row in rows),
        "refused": dict(Counter(row.reason for row in refused)),
        "repairs_refused": refused_repairs(rows),
        "tie_breaks": sum(row.reason.startswith("tie-break") for row in rows),
        "scorers": {name: getattr(tried[0], f"{name}_metric") for name in ("primary", "tiebreak") if tried},
        "mean_scores": means,
    }


def refused_repairs(rows: Sequence[Selection]) -> int:
    """Return the number of repairs that a gate refused."""
    return sum(row.reason.startswith(REFUSED) for row in rows)


def chosen_counts(rows: Sequence[Selection]) -> dict[Chosen, int]:
    """Return the number of rows per choice."""
    return {name: sum(row.chosen == name for row in rows) for name in CHOICES}
