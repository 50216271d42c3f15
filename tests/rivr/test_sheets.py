"""The contact sheet of the consolidation."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from cleargs.media.image import read_rgb
from cleargs.rivr import sheets
from cleargs.rivr.sheets import write_before_after_sheet


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
