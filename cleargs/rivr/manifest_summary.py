"""The figures that RIVR and the consolidation report in their manifests."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from statistics import fmean
from typing import Any

from cleargs.rivr.candidates import CANDIDATES, Chosen
from cleargs.rivr.gates import REFUSED
from cleargs.rivr.harm import Verdict
from cleargs.rivr.tables import Selection

CHOICES: tuple[Chosen, ...] = (*CANDIDATES, "observed")
"""What a row may name as chosen."""


def summary(rows: Sequence[Selection], expert: str, verdict: Verdict) -> dict[str, Any]:
    """What each round chose, and what came of the distillation."""
    rounds = sorted({row.round for row in rows})
    return {
        "expert": expert,
        "rounds": [_round(number, [row for row in rows if row.round == number]) for number in rounds],
        "held_back": verdict.summary(),
        "published": "distilled scene" if verdict.harm is None else "G0",
    }


def consolidation_summary(
    repairs: Sequence[Selection], kept: int, scorer: str, verdict: Verdict
) -> dict[str, Any]:
    """What was consolidated, beside how many frames that kept their raw image, and what came of it."""
    better = "consolidated scene" if verdict.harm is None else "RIVR's scene"
    return {
        "repairs": len(repairs),
        "chosen": chosen_counts(repairs) | {"observed": kept},
        "latest_rounds": dict(sorted(Counter(str(row.round) for row in repairs).items())),
        "scorer": scorer,
        "held_back": verdict.summary(),
        "published": better if repairs or kept else "G0",
    }


def _round(number: int, rows: Sequence[Selection]) -> dict[str, Any]:
    refused = [row for row in rows if not row.accepted and row.chosen != "observed"]
    means = {
        f"{role}_{name}": fmean(scores)
        for role in ("primary", "tiebreak")
        for name in CHOICES
        if (scores := [score for row in rows if (score := getattr(row, f"{role}_{name}")) is not None])
    }
    return {
        "round": number,
        "chosen": chosen_counts(rows),
        "accepted": sum(row.accepted for row in rows),
        "refused": dict(Counter(row.reason for row in refused)),
        "repairs_refused": refused_repairs(rows),
        "tie_breaks": sum(row.reason.startswith("tie-break") for row in rows),
        "scorers": {"primary": rows[0].primary_metric, "tiebreak": rows[0].tiebreak_metric},
        "mean_scores": means,
    }


def refused_repairs(rows: Sequence[Selection]) -> int:
    """How many repairs the gate kept out of the choice."""
    return sum(row.reason.startswith(REFUSED) for row in rows)


def chosen_counts(rows: Sequence[Selection]) -> dict[Chosen, int]:
    """How often each was chosen."""
    return {name: sum(row.chosen == name for row in rows) for name in CHOICES}
