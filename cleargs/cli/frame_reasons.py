"""What became of every frame, and why: the rows of rva/frames.parquet in words, with the repair chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cleargs.cli.manifest_words import AS_FILMED, text_of

COLUMNS = ("frame", "name", "role", "weight", "R", "B", "worst cue", "reason", "repair")

MAX_NAME_LENGTH = 14
"""Characters of a frame's name on the terminal."""

HARDLY = 0.2
"""A frame whose worst cue is off its best value by less has nothing to be told of."""


def frame_rows(
    rows: Sequence[Mapping[str, Any]],
    settings: Mapping[str, Any],
    repairs: Sequence[Mapping[str, Any]] | None,
) -> list[dict[str, Any]]:
    """One dictionary with `COLUMNS` a frame.

    rows: those of rva/frames.parquet; settings: the configuration that they were made with; repairs: the rows
    of rivr/selection.parquet, None before RIVR (then there is no column "repair").
    """
    latest = {row["frame_id"]: row for row in sorted(repairs or (), key=lambda row: int(row["round"]))}
    found = []
    for row in rows:
        line = {
            "frame": row["frame_id"],
            "name": row["name"],
            "role": row["role"],
            "weight": row["weight"],
            "R": row["R"],
            "B": row["B"],
            "worst cue": worst_cue(row),
            "reason": reason(row, settings),
        }
        if repairs is not None:
            line["repair"] = _repair(latest.get(row["frame_id"]))
        found.append(line)
    return found


def short_name(name: str) -> str:
    """The end of a frame's name, which tells it from the others."""
    last = name.rpartition("/")[2]
    return last if len(last) <= MAX_NAME_LENGTH else f"…{last[1 - MAX_NAME_LENGTH :]}"


def worst_cue(row: Mapping[str, Any]) -> str:
    """The cue farthest from its best value, and its value: "motion blur 0.82"; "" without a fault."""
    off = {name: 1.0 - value for name, value in row.items() if name.startswith("r_") and value is not None}
    off |= {name: value for name, value in row.items() if name.startswith("b_") and value is not None}
    if not off:
        return ""
    worst = max(off, key=lambda name: off[name])
    if off[worst] < HARDLY:
        return ""
    return f"{worst[2:].replace('_', ' ')} {row[worst]:.2f}"


def reason(row: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """Why the frame has its role: which threshold it passed or missed."""
    if row["R"] is None:
        return "not scored"
    if row["G"] is None:
        return "no pose found"
    if not settings["enabled"]:
        return "all frames count"
    role = row["role"]
    if role == "strong":
        return "reliable"
    if settings["weighting"] == "binary":
        return "among the best" if role == "auxiliary" else "not among the best"
    low = _missed(row, settings["auxiliary_R"], settings["auxiliary_B"])
    missed = low or _missed(row, settings["tau_R"], settings["tau_B"])
    if role == "geometric":
        return f"{missed}, adds views"
    if role == "auxiliary":
        return f"{missed}, usable"
    if row["reactivated_for"] == "coverage":
        return f"{missed}, fills a gap"
    return missed if low else f"{missed}, no new view"


def _missed(row: Mapping[str, Any], min_R: float, max_B: float) -> str:
    """Which of the two thresholds the frame misses; "" for none."""
    if row["R"] < min_R:
        return f"R < {text_of(min_R)}"
    return f"B > {text_of(max_B)}" if row["B"] > max_B else ""


def _repair(row: Mapping[str, Any] | None) -> str:
    """What RIVR chose for a frame in its last round: the layer that supervises, refused, or none."""
    from cleargs.rivr.gates import REFUSED

    if row is None:
        return "none"
    if row["chosen"] == "observed":
        return AS_FILMED
    refused = not row["accepted"] or row["reason"].startswith(REFUSED)
    return "refused" if refused else str(row["chosen"])
