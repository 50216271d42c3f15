"""The contact sheets of RIVR and the consolidation."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from cleargs.media.image import read_rgb
from cleargs.rivr import sheets
from cleargs.rivr.sheets import write_before_after_sheet, write_candidates_sheet


@pytest.mark.parametrize(("repaired", "columns"), [((), 3), ((2,), 4)])
def test_the_repairs_have_a_column_where_there_are_any(
    repaired: tuple[int, ...], columns: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grey = np.full((32, 200, 3), 0.5, np.float32)
    monkeypatch.setattr(sheets, "observation", lambda view: (grey, None))
    scene: Any = SimpleNamespace(render=lambda view: grey)
    row = SimpleNamespace(layers=lambda folder: {"restored": grey}, chosen="restored", round=1)
    views = [SimpleNamespace(frame_id=frame_id) for frame_id in (1, 2)]
    repairs = dict.fromkeys(repaired, cast(Any, row))
    write_before_after_sheet(tmp_path / "a.png", cast(Any, views), scene, scene, repairs, tmp_path)
    assert read_rgb(tmp_path / "a.png").shape[1] == columns * (480 + 4) - 4  # tiles and the gaps between them


@pytest.mark.parametrize(("chosen", "marked"), [("observed", []), ("restored", ["restored 88.7 / 71.0"])])
def test_a_frame_that_is_kept_as_filmed_is_no_winner(
    chosen: str, marked: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grey = np.full((32, 200, 3), 0.5, np.float32)
    row: Any = SimpleNamespace(
        frame_id=1,
        round=1,
        chosen=chosen,
        layers=lambda folder: {"observed": grey, "restored": grey},
        primary_observed=85.3,
        tiebreak_observed=70.0,
        primary_restored=88.7,
        tiebreak_restored=71.0,
    )
    tiles: list[Any] = []
    monkeypatch.setattr(
        sheets, "contact_sheet", lambda rows: tiles.extend(rows[0]) or np.zeros((4, 4, 3), np.uint8)
    )
    write_candidates_sheet(tmp_path / "a.png", [row], tmp_path)
    assert [tile.label for tile in tiles if tile.marked] == marked
    assert ("kept as filmed" in tiles[0].label) == (chosen == "observed")
