"""A run folder never shows results of other settings or inputs than its own."""

from __future__ import annotations

import shutil
import signal

import pytest
from test_interruption import start, wait_for
from toy import Bench

from cleargs.digest import DigestMemo
from cleargs.manifest import read_manifest
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.store import Store


def shown(bench: Bench) -> list[str]:
    return [name for name in bench.dag.names if (bench.folder / name).exists()]


def reasons(bench: Bench) -> dict[str, tuple[str, ...]]:
    """Return the reasons that `cleargs status` gives for each stage that is not done."""
    run = read_run_file(bench.folder, bench.dag)
    with DigestMemo(run.store / "digests.json") as memo:
        plans = Planner(bench.dag, run, Store(run.store, memo), 1, bench.remarks).plan()
        return {plan.stage: plan.reasons for plan in plans if plan.state != "done"}


def test_changed_setting_hides_what_it_affects(bench: Bench) -> None:
    bench.run()
    bench.run("square.power=3", until="count")
    assert shown(bench) == ["count"]
    assert reasons(bench) == {"square": ("setting square.power: 2 -> 3",), "total": ("waits for square",)}
    bench.work_done()
    bench.run()
    assert shown(bench) == list(bench.dag.names) and bench.work_done() == [], "old results are kept"
    assert reasons(bench) == {} and not list(bench.folder.glob(".*.before"))


def test_changed_input_and_seed_hide_everything_first(bench: Bench) -> None:
    bench.run()
    (bench.capture / "1.txt").write_text("no number")
    with pytest.raises(ValueError, match="no number"):
        bench.run()
    assert shown(bench) == ["count"], "count succeeded with the new input"
    (bench.capture / "1.txt").write_text("1")
    bench.run()
    bench.run(seed=4, until="count")
    assert shown(bench) == ["count"]


def test_new_results_hide_what_was_made_from_the_old_ones(bench: Bench) -> None:
    bench.run()
    bench.run("count.limit=3", until="count")
    assert shown(bench) == ["count"]
    assert reasons(bench)["square"] == ("input count/numbers: 3.txt removed, 4.txt removed, 5.txt removed",)
    bench.run("count.limit=3", until="square")
    assert shown(bench) == ["count", "square"]


def test_newer_program_hides_nothing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.run()
    monkeypatch.setattr(bench.dag.load("square"), "VERSION", 2)
    monkeypatch.setattr(bench.dag.load("square"), "LIBRARIES", ("click",))
    assert bench.plan()["square"].state == "missing", "a run would run it again"
    bench.run(until="count")
    assert shown(bench) == list(bench.dag.names)


def test_killed_after_a_change_shows_nothing_of_before(bench: Bench) -> None:
    bench.run()
    hold = bench.root / "hold"
    hold.touch()
    process = start(bench, "square.power=3", f"square.hold={hold}")
    wait_for(bench, "held")
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert shown(bench) == ["count"] and "square" in reasons(bench)
    hold.unlink()
    bench.run("square.power=3")
    assert shown(bench) == list(bench.dag.names)


def test_files_of_a_user_stay(bench: Bench) -> None:
    bench.run(until="count")
    (bench.folder / "total").mkdir()
    (bench.folder / "total" / "mine.txt").write_text("keep me")
    bench.run("count.limit=3", until="count")
    assert (bench.folder / "total" / "mine.txt").read_text() == "keep me"


def test_results_without_manifest_are_hidden(bench: Bench) -> None:
    bench.run()
    (bench.folder / "square" / "manifest.json").write_text("{")
    bench.run(until="count")
    assert shown(bench) == ["count"]
    bench.run()
    assert shown(bench) == list(bench.dag.names)


def test_earlier_results_of_a_run_may_be_removed(bench: Bench) -> None:
    bench.run()
    before = read_manifest(bench.folder / "square").key
    bench.run("square.power=3")
    shutil.rmtree(bench.store / "square" / before)
    bench.run(until="count")
    assert reasons(bench)["square"] == ("setting square.power: 3 -> 2",)
