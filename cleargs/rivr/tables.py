"""The tables of RIVR and consolidation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import pyarrow as pa

from cleargs.digest import is_inside
from cleargs.errors import StoreError
from cleargs.media.exr import Layer, read_exr
from cleargs.parquet import read_table, schema_of, write_table
from cleargs.rivr.candidates import CANDIDATES, OBSERVED, REFUSED, Scores, Source

_NAME = "name of the scorer that decides"
_SCORES = "candidate, or observed (the frame image, if it may be kept) -> score, 0-100, by the scorer"
SCORES = pa.map_(pa.string(), pa.float32())


@dataclass(frozen=True)
class Selection:
    """One row of ``rivr/selection.parquet``. Scores are float32 values, as the EXR holds them."""

    round: Annotated[int, "from 1"]
    frame_id: Annotated[int, "target frame t"]
    exr: Annotated[
        str | None,
        "layers: the candidates, observed, deblurred, explained; below the rivr folder; null where "
        "the frame was not tried",
    ]
    primary_metric: Annotated[str | None, _NAME]
    primary: Annotated[Scores, SCORES, f"{_SCORES} that decides"]
    tiebreak_metric: Annotated[
        str | None, f"{_NAME} among the candidates within rivr.margin of the best primary score"
    ]
    tiebreak: Annotated[Scores, SCORES, f"{_SCORES} that decides near-ties"]
    restored_from: Annotated[
        Source | None, "image that the expert restored to D_t: observed, deblurred or render"
    ]
    blur_px: Annotated[float | None, pa.float32(), "mean way of the pixels while exposed, as undone"]
    skew_px: Annotated[float | None, pa.float32(), "their mean way from the first to the last row"]
    chosen: Annotated[str, "a candidate; observed: the frame image needs no repair"]
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
        row: dict[str, Any] = dict.fromkeys(SELECTION.names) | {"round": 1, "frame_id": frame_id}
        row |= {"primary": {}, "tiebreak": {}, "chosen": OBSERVED, "accepted": False, "reason": reason}
        return cls(**row)


@dataclass(frozen=True)
class Repair:
    """One row of ``consolidate/repairs.parquet``."""

    frame_id: Annotated[int, "frame with an accepted repair"]
    round: Annotated[int, "its latest accepted round, from 1"]
    exr: Annotated[str, "layered EXR, relative to the rivr folder"]
    chosen: Annotated[str, "layer that supervises: a candidate"]


SELECTION, REPAIRS = schema_of(Selection), schema_of(Repair)


def write_selection(path: Path, rows: list[Selection]) -> None:
    """Write the rows in their order."""
    write_table(path, pa.Table.from_pylist([asdict(row) for row in rows], SELECTION), SELECTION)


def read_selection(path: Path) -> list[Selection]:
    """Read the rows in their order. Raise StoreError if the table is missing or damaged."""
    return [Selection(**row) for row in read_table(path, SELECTION).to_pylist(maps_as_pydicts="strict")]


def latest_accepted(rows: Sequence[Selection]) -> list[Selection]:
    """Return the latest accepted row of every frame with a repair, by frame_id."""
    kept = kept_raw(rows)
    latest = {row.frame_id: row for row in sorted(rows, key=lambda row: row.round) if row.accepted}
    return [latest[frame_id] for frame_id in sorted(latest.keys() - kept)]


def kept_raw(rows: Sequence[Selection]) -> set[int]:
    """Return the frames whose latest row says that they need no repair.

    The latest scene is the best reference, so this revokes an earlier repair, as a later repair does.
    """
    latest = {row.frame_id: row for row in sorted(rows, key=lambda row: row.round)}
    return {frame_id for frame_id, row in latest.items() if row.chosen == OBSERVED}


def repaired_share(rows: Sequence[Selection]) -> float:
    """Return the share of repaired frames among those that are repaired or kept; 0 without either."""
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
    refused = [row for row in rows if not row.accepted and row.chosen != OBSERVED]
    means = {
        f"{role}_{name}": fmean(scores[name] for scores in found if name in scores)
        for role in ("primary", "tiebreak")
        if (found := [getattr(row, role) for row in tried])
        for name in dict.fromkeys(name for scores in found for name in scores)
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


def chosen_counts(rows: Sequence[Selection]) -> dict[str, int]:
    """Return the number of rows per choice, which is 0 for those of `CANDIDATES` that no row has."""
    names = [*CANDIDATES, *(row.chosen for row in rows if row.chosen != OBSERVED), OBSERVED]
    return {name: sum(row.chosen == name for row in rows) for name in names}
