"""Frames that mapping leaves out: which features are found again, and which result is kept."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cleargs.capture import mapping
from cleargs.capture.config import SfmConfig

from .conftest import Ingest

NAMES = [f"{index:02d}.png" for index in range(12)]


class Placer(mapping.Mapper):
    """Maps by a script: the numbers of the frames that each try has placed at its end."""

    def __init__(self, tries: list[set[int]]) -> None:
        self.job = cast(Any, SimpleNamespace(names=NAMES, config=SfmConfig(overlap=2)))
        self._report = lambda **_: None
        self.database = Path("database.db")
        self._tries = iter(tries)
        self.extracted: list[list[str]] = []
        self.matched: list[int] = []

    def extract(self, database: Path, names: Any, settings: Any) -> None:
        self.extracted.append(list(names))

    def match(self, database: Path, pairs: Any, again: str = "") -> None:
        self.matched.append(len(pairs))

    def _continued(self, model: Any, database: Path, again: set[int], settings: Any) -> Any:
        return made(next(self._tries))


def made(placed: set[int]) -> Any:
    return SimpleNamespace(
        images={i: SimpleNamespace(name=NAMES[i], image_id=i + 1, has_pose=True) for i in placed}
    )


@pytest.fixture(autouse=True)
def no_database(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapping, "copy_without_features", lambda *_: None)
    monkeypatch.setattr(mapping, "why_missing", lambda _, missing: dict.fromkeys(missing.values(), "why"))


PAIRS = [(i, i + 1) for i in range(11)]


def test_neighbours_of_frames_that_are_left_out_get_new_features_too() -> None:
    placer = Placer([set(range(8)), set(range(12))])
    model, placed = placer._place_the_rest(made(set(range(8))), PAIRS)
    assert len(model.images) == 12
    # First those left out alone, then also the two frames before them, which connect them with the others.
    assert placer.extracted == [NAMES[8:], NAMES[6:]] and placer.matched == [4, 6]
    assert [placed[name] for name in NAMES] == ["sfm"] * 8 + ["sfm with fainter features"] * 4


def test_a_try_that_loses_a_frame_is_not_taken() -> None:
    placer = Placer([set(range(8)), set(range(1, 12))])
    model, placed = placer._place_the_rest(made(set(range(8))), PAIRS)
    assert len(model.images) == 8 and placer.used_database == Path("database.db")
    assert [placed[name] for name in NAMES] == ["sfm"] * 8 + ["why"] * 4


def test_what_the_second_try_places_needs_no_third() -> None:
    placer = Placer([set(range(12))])
    _, placed = placer._place_the_rest(made(set(range(8))), PAIRS)
    assert [placed[name] for name in NAMES] == ["sfm"] * 8 + ["sfm at half resolution"] * 4


@pytest.mark.slow
def test_a_cut_to_another_place_is_named(
    tmp_path: Path, frames: list[tuple[NDArray[np.float64], NDArray[np.uint8]]], ingest: Ingest
) -> None:
    """A picture upside down and mirrored has no matches with the others."""
    folder = tmp_path / "in"
    folder.mkdir()
    for number, (_, image) in enumerate([*frames[:8], *frames[:6]]):
        shown = image if number < 8 else cv2.flip(255 - image, 0)
        cv2.imwrite(str(folder / f"view{number:02d}.png"), np.ascontiguousarray(shown))
    done = ingest(folder)
    assert done.result.summary["registered"] == 8
    warning = next(text for text in done.warnings if "another place" in text)
    assert "6 frames (view08.png to view13.png)" in warning
