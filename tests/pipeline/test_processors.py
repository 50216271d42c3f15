"""Machines with processors of two kinds that share a store: their results differ in bits, not in keys."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

import pytest
from toy import Bench, make_bench

from cleargs import manifest
from cleargs.digest import DigestMemo
from cleargs.manifest import instruction_set, linked_manifest, read_manifest, write_manifest
from cleargs.pipeline.stage import StageContext, StageResult
from cleargs.pipeline.store import Store

FLAGS = "flags\t\t: fpu sse sse2 cx16 popcnt sse4_1 sse4_2{}\nbugs : none\n"


@pytest.mark.parametrize(
    ("more", "level"), [("", 2), (" avx avx2 fma", 3), (" avx avx2 fma avx512f avx512bw", 4)]
)
def test_the_instruction_set_has_a_short_name(
    more: str, level: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    (tmp_path / "cpuinfo").write_text(FLAGS.format(more))
    assert instruction_set(tmp_path / "cpuinfo") == f"x86-64-v{level}"
    assert instruction_set(tmp_path / "absent") == "x86_64"
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert instruction_set(tmp_path / "cpuinfo") == "aarch64"


class Machine:
    """A machine whose processor rounds in its own way: the first number of ``count`` differs."""

    def __init__(self, bench: Bench, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
        self.bench, self.kind, self._patch = bench, kind, monkeypatch
        self._count = bench.dag.load("count")

    def run(self, *, force: tuple[str, ...] = ()) -> dict[str, str]:
        """Run the toy run on this machine. Return stage -> "found" or "made"."""
        original: Any = type(self._count).run

        def rounded(stage: Any, context: StageContext[Any]) -> StageResult:
            result: StageResult = original(self._count, context)
            (context.out / "numbers/0.txt").write_text("1" if self.kind.endswith("v4") else "2")
            return result

        with self._patch.context() as patch:
            patch.setattr(manifest, "instruction_set", lambda: self.kind)
            patch.setattr(type(self._count), "run", rounded)
            return {outcome.stage: outcome.how for outcome in self.bench.run(force=force)}


@pytest.fixture
def machines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Machine, Machine]:
    bench = make_bench(tmp_path)
    return Machine(bench, "x86-64-v3", monkeypatch), Machine(bench, "x86-64-v4", monkeypatch)


def test_machines_of_two_kinds_continue_each_others_run(machines: tuple[Machine, Machine]) -> None:
    old, new = machines
    assert set(old.run().values()) == {"made"}
    manifest = linked_manifest(old.bench.folder, "count")
    assert manifest is not None and manifest.versions["processor"] == "x86-64-v3"
    for machine in (new, old, new):
        assert set(machine.run().values()) == {"found"}, "no machine replaces the results of the other"
    assert linked_manifest(old.bench.folder, "count") == manifest


def test_forcing_names_the_other_kind(machines: tuple[Machine, Machine]) -> None:
    old, new = machines
    old.run()
    assert new.run(force=("count",)) == {"count": "made", "square": "made", "total": "made"}
    (warning,) = old.bench.remarks.warnings
    assert "other digests than before, which were made on x86-64-v3, not x86-64-v4" in warning
    assert set(old.run().values()) == {"found"}, "they do not take turns"


def test_the_first_published_result_stays(machines: tuple[Machine, Machine], tmp_path: Path) -> None:
    """Two machines compute the same at the same time, on a file system without locks."""
    bench = machines[0].bench
    machines[0].run()
    first = read_manifest(bench.folder / "total")
    other = first.model_copy(update={"digest": "0" * 64, "versions": {"processor": "x86-64-v4"}})
    with DigestMemo(tmp_path / "memo.sqlite") as memo:
        store = Store(bench.store, memo)
        for forced, winner in ((False, first), (True, other)):
            work = store.open_work(first.key, forced=forced, entry=None)
            for name in first.files:
                (work.out / name).write_bytes((bench.folder / "total" / name).read_bytes())
            assert store.publish(work, other, forced=forced) == winner


def test_results_from_before_are_still_found(machines: tuple[Machine, Machine]) -> None:
    """Manifests of earlier versions do not name the processor."""
    old, new = machines
    old.run()
    for stage in ("count", "square", "total"):
        folder = (old.bench.folder / stage).resolve()
        manifest = read_manifest(folder)
        versions = {name: text for name, text in manifest.versions.items() if name != "processor"}
        write_manifest(folder, manifest.model_copy(update={"versions": versions}))
    assert set(new.run().values()) == {"found"}
