"""The words that a round of RIVR shows while it works."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cleargs.progress import CountedTask, SilentReporter, Task
from cleargs.rivr import rounds


def test_a_round_says_how_many_frames_it_kept_as_filmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once, the words were the names of the candidates, also of those that were off."""
    chosen = {3: "observed", 4: "fused", 5: "observed"}
    notes: list[str] = []

    class Notes(SilentReporter):
        @contextmanager
        def task(self, label: str, total: int | None = None) -> Iterator[Task]:
            yield CountedTask(total, lambda done, note, left: notes.append(note))

    def finished(out: Path, exr: str) -> Any:
        frame = int(Path(exr).stem)
        return SimpleNamespace(round=1, frame_id=frame, chosen=chosen[frame])

    monkeypatch.setattr(rounds, "read_row", finished)
    views: Any = [SimpleNamespace(frame_id=frame) for frame in chosen]
    unused: Any = None
    rounds.run_round(1, views, unused, unused, tmp_path, Notes(), "round 1")
    assert notes[-1] == "2 kept as filmed, 1 repaired"
