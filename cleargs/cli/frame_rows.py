"""The lines of ``cleargs show RUN rva``: for each frame its role, its scores, and the reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

MAX_NAME_LENGTH = 14  # characters of a frame's name in a table


def frame_rows(
    rows: Sequence[Mapping[str, Any]],
    settings: Mapping[str, Any],
    repairs: Sequence[Mapping[str, Any]] | None,
) -> list[dict[str, Any]]:
    """Return role, scores, worst cue, reason and repair of each row of ``rva/frames.parquet``.

    ``settings`` are those with which RVA made the rows. ``repairs`` are the rows of
    ``rivr/selection.parquet``. Before RIVR they are None, and the result has no "repair".
    """
    from cleargs.report.frames import worst_cue

    latest = {row["frame_id"]: row for row in sorted(repairs or (), key=lambda row: int(row["round"]))}
    found = []
    for row in rows:
        line = {"frame": row["frame_id"], **{key: row[key] for key in ("name", "role", "weight", "R", "B")}}
        line |= {"worst cue": worst_cue(row), "reason": reason(row, settings)}
        if repairs is not None:
            line["repair"] = _repair(latest.get(row["frame_id"]))
        found.append(line)
    return found


def score_text(score: str, value: float, settings: Mapping[str, Any]) -> str:
    """Format R, B or G with two decimals, or with as many as tell it from the thresholds of `reason`."""
    limits = [settings[f"{rule}_{score}"] for rule in ("tau", "auxiliary") if f"{rule}_{score}" in settings]
    digits = 2
    while digits < 6 and round(value, digits) in limits:
        digits += 1
    return f"{value:.{digits}f}"


def short_name(name: str) -> str:
    """Return the end of a frame's name, which differs most between frames."""
    last = name.rpartition("/")[2]
    return last if len(last) <= MAX_NAME_LENGTH else f"…{last[1 - MAX_NAME_LENGTH :]}"


def reason(row: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """Return the reason for the role of a frame: the threshold that it passed or missed."""
    if row["R"] is None:
        return "not scored"
    if row["G"] is None:
        return "no pose found"
    if not settings["enabled"]:
        return "all frames count"
    if row["role"] == "strong":
        return "reliable"
    if settings["weighting"] == "binary":
        return "among the best" if row["role"] == "auxiliary" else "not among the best"
    low = _missed(row, settings["auxiliary_R"], settings["auxiliary_B"])
    missed = low or _missed(row, settings["tau_R"], settings["tau_B"])
    if row["reactivated_for"] == "coverage":
        return f"{missed}, fills a gap"
    weak = missed if low else f"{missed}, no new view"
    return {"geometric": f"{missed}, adds views", "auxiliary": f"{missed}, usable"}.get(row["role"], weak)


def _missed(row: Mapping[str, Any], min_R: float, max_B: float) -> str:
    """Return the first of the two thresholds that the frame misses; "" if it misses none."""
    if row["R"] < min_R:
        return f"R < {min_R:.4g}"
    return f"B > {max_B:.4g}" if row["B"] > max_B else ""


def _repair(row: Mapping[str, Any] | None) -> str:
    """Return RIVR's choice in the last round of a frame: a layer, "as filmed", "refused" or "none"."""
    from cleargs.rivr.candidates import REFUSED

    if row is None:
        return "none"
    if row["chosen"] == "observed":
        return "as filmed"
    return "refused" if not row["accepted"] or row["reason"].startswith(REFUSED) else str(row["chosen"])
