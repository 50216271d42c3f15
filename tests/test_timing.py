"""Time of a stage by its parts."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest

from cleargs.cli.time_table import REST, time_rows
from cleargs.timing import PartTime, recorded, timed


def test_parts_nest_and_are_counted() -> None:
    with recorded() as times:
        for _ in range(3):
            with timed("training"):
                with timed("rendering"):
                    sum(range(20_000))
                with timed("loss"), timed("rendering"):
                    pass
        with timed("training"):
            pass
    rows = {row.part: row for row in times.rows()}
    assert list(rows) == [
        ("training",),
        ("training", "rendering"),
        ("training", "loss"),
        ("training", "loss", "rendering"),
    ]
    assert [row.times for row in rows.values()] == [4, 3, 3, 3]
    assert rows["training",].seconds >= rows["training", "rendering"].seconds > 0.0
    assert rows["training",].cpu_seconds > 0.0


def test_a_part_ends_with_an_error() -> None:
    with recorded() as times:
        with pytest.raises(ValueError), timed("first"):
            raise ValueError
        with timed("second"):
            pass
    assert [row.part for row in times.rows()] == [("first",), ("second",)]


def test_other_threads_and_work_outside_are_not_recorded() -> None:
    def work() -> None:
        with timed("elsewhere"):
            pass

    with recorded() as times, timed("here"), ThreadPoolExecutor(1) as pool:
        pool.submit(work).result()
    work()
    assert [row.part for row in times.rows()] == [("here",)]


def test_the_table_shows_parts_under_their_stage() -> None:
    parts = [(("G0",), 8.0), (("G0", "rendering"), 5.0), (("G0", "loss"), 0.01), (("dust",), 1.0)]
    timing = [PartTime(part=part, seconds=2 * cpu, cpu_seconds=cpu, times=3) for part, cpu in parts]
    stage = SimpleNamespace(seconds=20.0, cpu_seconds=10.0, timing=timing)
    rows = list(time_rows({"g0": stage}))  # type: ignore[dict-item]
    assert [row[0] for row in rows] == ["g0", "  G0", "    rendering", f"    {REST}", "  dust", f"  {REST}"]
    assert [row[2] for row in rows] == ["10.0", "8.0", "5.0", "3.0", "1.0", "1.0"]
    assert [len(row[4]) for row in rows] == [20, 16, 10, 6, 2, 2]
