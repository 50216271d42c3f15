"""Number of frames of a scene by role. It shows which rules of RVA have an effect in a table."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from cleargs.base_model import FrozenModel
from cleargs.parquet import read_table
from cleargs.rva.allocation import Role, Rule
from cleargs.rva.tables import FRAMES

FOR_COVERAGE = f"{Role.REACTIVATED} for {Rule.COVERAGE}"
FOR_SHARE = f"{Role.REACTIVATED} for {Rule.ACTIVE_SHARE}"
KINDS = (Role.STRONG, Role.GEOMETRIC, Role.AUXILIARY, FOR_COVERAGE, FOR_SHARE, Role.SUPPRESSED)
"""Roles of a frame; reactivated ones by the rule that reactivated them."""


class Roles(FrozenModel):
    """Training frames of one scene by role."""

    column: str
    sample: str
    variant: str
    frames: dict[str, int]
    """Each of `KINDS` -> number of frames."""


def count_roles(rva: Path) -> dict[str, int]:
    """Return the number of training frames for each of `KINDS`, from the finished folder of RVA."""
    rows = read_table(rva / "frames.parquet", FRAMES).to_pylist()
    found = Counter(
        f"{row['role']} for {row['reactivated_for']}" if row["reactivated_for"] else row["role"]
        for row in rows
    )
    return {str(kind): found[kind] for kind in KINDS}
