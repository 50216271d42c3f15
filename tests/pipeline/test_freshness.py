"""What is called stale, for all commands alike."""

from __future__ import annotations

import os
import shutil

import pytest
from toy import Bench

from cleargs.errors import InputError
from cleargs.pipeline.freshness import require_fresh, stale_stages
from cleargs.pipeline.run_file import read_run_file


def stale(bench: Bench) -> dict[str, tuple[str, ...]]:
    return stale_stages(bench.dag, read_run_file(bench.folder, bench.dag))


def test_a_finished_run_is_fresh(bench: Bench) -> None:
    bench.run()
    assert stale(bench) == {}
    assert require_fresh(bench.dag, bench.folder, bench.dag.names) == ""


def test_a_setting_changed_for_an_earlier_stage_makes_the_later_ones_stale(bench: Bench) -> None:
    bench.run()
    bench.run("count.limit=3", until="count")
    found = stale(bench)
    assert list(found) == ["square", "total"]
    assert found["square"] == ("input count/numbers: 3.txt removed, 4.txt removed, 5.txt removed",)
    assert "it was made from stale square" in found["total"]
    with pytest.raises(InputError, match="total is stale") as error:
        require_fresh(bench.dag, bench.folder, ("total",))
    assert "cleargs run" in error.value.hint and "--stale" in error.value.hint
    assert "total is stale" in require_fresh(bench.dag, bench.folder, ("total",), stale=True)
    assert require_fresh(bench.dag, bench.folder, ("count",)) == ""
    bench.run("count.limit=3")
    assert stale(bench) == {}


def test_its_own_setting_and_the_seed(bench: Bench) -> None:
    bench.run()
    bench.run("square.power=3", until="count")
    assert stale(bench)["square"] == ("setting square.power: 2 -> 3",)
    bench.run(seed=4, until="count")
    assert stale(bench)["total"] == ("seed: 0 -> 4", "it was made from stale square")


def test_equal_content_further_up_makes_nothing_stale(bench: Bench) -> None:
    bench.run()
    bench.run("count.inner.depth=4", until="count")  # changes the key of count, not what it publishes
    assert stale(bench) == {}


def test_a_changed_capture(bench: Bench) -> None:
    bench.run()
    (bench.capture / "1.txt").write_text("50")
    assert stale(bench)["count"] == ("external capture: 1.txt changed",)
    assert set(stale(bench)) == {"count", "square", "total"}


def test_a_capture_that_is_gone_makes_nothing_stale(bench: Bench) -> None:
    bench.run()
    shutil.rmtree(bench.capture)
    assert stale(bench) == {}


def test_a_newer_program_makes_nothing_stale(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.run()
    monkeypatch.setattr(bench.dag.load("square"), "VERSION", 2)
    monkeypatch.setattr(bench.dag.load("square"), "LIBRARIES", ("click",))
    assert bench.plan()["square"].state == "miss", "a run would make it again"
    assert stale(bench) == {}


def test_a_stage_without_what_it_was_made_from(bench: Bench) -> None:
    bench.run()
    (bench.folder / "count").unlink()
    assert stale(bench)["square"] == ("it was made from count, which is not there",)


def test_results_without_their_manifest(bench: Bench) -> None:
    bench.run()
    (bench.folder / "total" / "manifest.json").write_text("{")
    assert stale(bench) == {"total": ("its manifest is missing or damaged",)}
    with pytest.raises(InputError, match="total is stale"):
        require_fresh(bench.dag, bench.folder, ("total",))


def test_damaged_results_are_refused_too(bench: Bench) -> None:
    """What was made from them is as it was: it names the content that they had."""
    bench.run()
    file = bench.folder / "square" / "powers" / "3.txt"
    before = file.stat()
    file.write_text("7")
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert stale(bench) == {"square": ("powers/3.txt has other content",)}
    with pytest.raises(InputError, match="square is stale: powers/3"):
        require_fresh(bench.dag, bench.folder, ("square",))
    bench.run()
    assert stale(bench) == {}
