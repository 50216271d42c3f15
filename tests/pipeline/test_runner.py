"""The runner runs the stages that need it, and no others."""

from __future__ import annotations

import json
import os
import resource
import shutil
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pytest
from toy import Bench

from cleargs.digest import DigestMemo, json_digest
from cleargs.errors import InputError, StageError, StoreError
from cleargs.files import write_json
from cleargs.manifest import MANIFEST, read_manifest, write_manifest
from cleargs.parquet import column, table_meanings, write_table
from cleargs.pipeline.plan import Planner, StagePlan, cost_line
from cleargs.pipeline.runner import Runner, check_same_input
from cleargs.pipeline.stage import Estimate
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import Store
from cleargs.types import Device


def stages_run(bench: Bench) -> list[str]:
    return [line for line in bench.work_done() if " " not in line]


def test_run_makes_every_stage_and_links_it(bench: Bench) -> None:
    outcomes = bench.run()
    assert [outcome.how for outcome in outcomes] == ["made"] * 3
    assert (bench.folder / "total" / "total.txt").read_text() == "plain 55.0 0"
    for name in bench.dag.names:
        link = bench.folder / name
        assert link.is_symlink() and not link.readlink().is_absolute()
        manifest = read_manifest(link)
        assert manifest.status == "complete" and manifest.parts.stage == name
    assert read_manifest(bench.folder / "count").summary == {"numbers": 6, "scale": None}
    assert list((bench.store / "work").iterdir()) == []


def test_second_run_does_nothing_and_leaves_files_alone(bench: Bench) -> None:
    bench.run()
    before = {file: file.stat().st_mtime_ns for file in bench.store.rglob("*.txt")}
    run_file = (bench.folder / "run.toml").stat().st_mtime_ns
    bench.work_done()
    assert [outcome.how for outcome in bench.run()] == ["found"] * 3
    assert bench.work_done() == []
    assert {file: file.stat().st_mtime_ns for file in bench.store.rglob("*.txt")} == before
    assert (bench.folder / "run.toml").stat().st_mtime_ns == run_file


def test_a_setting_affects_its_stage_and_later_ones(bench: Bench) -> None:
    bench.run()
    bench.work_done()
    bench.run("square.power=3")
    assert stages_run(bench) == ["square", "total"]
    bench.run()
    assert stages_run(bench) == [], "the results of the old settings are still in the store"
    assert (bench.folder / "total" / "total.txt").read_text() == "plain 55.0 0"


def test_equal_content_upstream_cuts_off(bench: Bench) -> None:
    bench.run()
    bench.work_done()
    bench.run("count.mode=padded")  # changes log.txt, which only `total` reads
    assert stages_run(bench) == ["count", "total"]


def test_threads_and_settings_outside_the_key_keep_the_hit(bench: Bench) -> None:
    bench.run()
    bench.work_done()
    bench.run("square.delay_s=0.001", threads=2)
    assert bench.work_done() == []


def test_seed_affects_every_stage(bench: Bench) -> None:
    bench.run()
    bench.work_done()
    bench.run(seed=1)
    assert stages_run(bench) == ["count", "square", "total"]


def test_touched_input_is_a_hit_changed_input_is_not(bench: Bench) -> None:
    bench.run()
    bench.work_done()
    os.utime(bench.capture / "3.txt", ns=(1, 1))
    bench.run()
    assert bench.work_done() == []
    (bench.capture / "3.txt").write_text("7")  # the same size
    bench.run()
    assert stages_run(bench) == ["count", "square", "total"]


def test_external_file_counts_by_content_not_by_path(bench: Bench) -> None:
    weights = bench.root / "a.bin"
    weights.write_bytes(b"weights")
    bench.run(f"count.weights={weights}")
    bench.work_done()
    moved = weights.rename(bench.root / "b.bin")
    bench.run(f"count.weights={moved}")
    assert bench.work_done() == []
    moved.write_bytes(b"others!")
    bench.run(f"count.weights={moved}")
    assert stages_run(bench) == ["count"], "later stages read equal content"


def test_moved_workspace_is_a_hit(bench: Bench) -> None:
    bench.run()
    bench.work_done()
    place = bench.root / "elsewhere"
    place.mkdir()
    bench.capture.rename(place / "capture")
    bench.folder.rename(place / "run")
    moved = replace(bench, root=place)
    assert [outcome.how for outcome in moved.run()] == ["found"] * 3
    assert bench.work_done() == []
    assert (place / "run" / "total" / "total.txt").exists()


def test_shared_store_serves_two_runs(bench: Bench, tmp_path: Path) -> None:
    store = tmp_path / "shared"
    bench.run(store=store)
    bench.work_done()
    shutil.rmtree(bench.folder)
    assert [outcome.how for outcome in bench.run(store=store)] == ["found"] * 3
    assert bench.work_done() == []
    assert (bench.folder / "count").readlink().is_absolute()


def test_new_version_of_a_stage_is_a_miss(bench: Bench) -> None:
    bench.run()
    bench.work_done()
    stages = {name: bench.dag.load(name) for name in bench.dag.names}
    stages["square"] = replace(stages["square"], VERSION=2)  # type: ignore[type-var]  # a dataclass behind a protocol
    newer = replace(bench, dag=Stages(bench.dag.names, stages.__getitem__))
    assert newer.plan()["square"].reasons == ("stage version: 1 -> 2",)
    newer.run()
    assert stages_run(bench) == ["square"], "total reads equal content"


def test_until_and_force(bench: Bench) -> None:
    assert [outcome.stage for outcome in bench.run(until="square")] == ["count", "square"]
    assert not (bench.folder / "total").exists()
    bench.run()
    bench.work_done()
    outcomes = bench.run(force=["square"])
    assert stages_run(bench) == ["square"], "equal results: no later stage runs"
    assert [outcome.how for outcome in outcomes] == ["found", "made", "found"]
    assert any("same digests" in line for line in bench.remarks.lines)
    with pytest.raises(InputError, match="no stage 'sqare'") as error:
        bench.run(until="sqare")
    assert error.value.hint == "did you mean square?"


def test_a_forced_stage_reports_the_time_of_this_attempt(bench: Bench) -> None:
    """An equal result keeps its manifest, with the times of the first attempt."""
    square = bench.run()[1]
    write_manifest(square.folder, square.manifest.model_copy(update={"seconds": 1000.0}))
    again = bench.run(force=["square"])[1]
    assert again.how == "made"
    assert again.manifest.digest == square.manifest.digest
    assert again.manifest.seconds < 500.0


def test_killed_during_cleanup_leaves_no_partial_checkpoints(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once, a later attempt could not resume from half of the checkpoints after the result was removed."""

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(shutil, "rmtree", killed)
        bench.run(until="square")
    work = bench.folder / ".store" / "work"
    assert [path.name for path in work.iterdir() if not path.name.startswith(".rubbish")] == []


@pytest.mark.parametrize("force", [(), ("square",)])
def test_checkpoints_do_not_outlive_their_outputs(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, force: tuple[str, ...]
) -> None:
    """Once, a stage resumed from the end of an attempt whose outputs were gone, and published the last only.

    The attempt was killed right after it had published, and then the results were collected.
    """
    square = bench.run()[1]

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    shutil.rmtree(square.folder)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Store, "discard", killed)
        bench.run(force=force)
    assert square.folder.is_dir()
    shutil.rmtree(square.folder)
    again = bench.run(force=force)[1]
    assert again.how == "made"
    assert again.manifest.files == square.manifest.files


def test_too_little_address_space_is_refused_before_any_work(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under ``ulimit -v 700000``, OpenBLAS requested memory in an endless loop."""
    monkeypatch.setattr(resource, "getrlimit", lambda _: (716_800_000, -1))
    with pytest.raises(InputError, match=r"virtual memory \(ulimit -v\) is 717 MB; 2.0 GB are needed"):
        bench.run()
    assert stages_run(bench) == []


def test_the_address_space_of_all_stages_is_checked_before_any_work(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """2.6 GB passed the first check, and g0 failed, with advice about the capture."""
    bench.run(until="count")
    bench.work_done()
    monkeypatch.setattr(resource, "getrlimit", lambda _: (2_600_000_000, -1))
    with pytest.raises(InputError, match=r"is 2.6 GB; 3.6 GB are needed"):
        bench.run()
    assert stages_run(bench) == []
    assert bench.run(until="count")[0].how == "found", "nothing is to be done"


def test_status_names_what_changed(bench: Bench) -> None:
    plans = bench.plan()
    assert [plan.state for plan in plans.values()] == ["missing"] * 3
    bench.run()
    assert [plan.state for plan in bench.plan().values()] == ["done"] * 3
    assert bench.plan("square.power=3", "total.offset=0.5")["square"].reasons == (
        "setting square.power: 2 -> 3",
    )
    assert bench.plan("count.inner.depth=4")["count"].reasons == ("setting count.inner.depth: 3 -> 4",)
    assert bench.plan(seed=4)["count"].reasons == ("seed: 0 -> 4",)
    (bench.capture / "2.txt").write_text("20")
    (bench.capture / "9.txt").write_text("9")
    assert bench.plan()["count"].reasons == ("external capture: 2.txt changed, 9.txt added",)
    bench.run(until="count")
    assert bench.plan()["square"].reasons == ("input count/numbers: 2.txt changed, 9.txt added",)
    shutil.rmtree((bench.folder / "count").resolve())
    (bench.folder / ".count.before").unlink(missing_ok=True)
    assert bench.plan()["count"].reasons == ("no results yet",)


def test_planning_writes_nothing(bench: Bench) -> None:
    bench.plan()
    assert not bench.folder.exists()


def test_failed_stage_leaves_nothing_that_counts_as_done(bench: Bench) -> None:
    (bench.capture / "2.txt").write_text("no number")
    with pytest.raises(ValueError):
        bench.run()
    assert not (bench.folder / "square").exists() and not (bench.store / "square").exists()
    (bench.capture / "2.txt").write_text("2")
    assert bench.run()[-1].manifest.status == "complete"


def test_stage_that_forgets_an_output_fails(bench: Bench) -> None:
    stages = {name: bench.dag.load(name) for name in bench.dag.names}
    stages["count"].OUTPUTS = ("numbers", "nothing.txt")
    with pytest.raises(StageError, match=r"without its outputs nothing\.txt"):
        bench.run()


def test_full_disk_is_noticed_before_work(bench: Bench) -> None:
    stages = {name: bench.dag.load(name) for name in bench.dag.names}
    huge = Estimate(minutes=1, memory_gb=1, disk_gb=1e9)
    object.__setattr__(stages["total"], "estimate", lambda context: huge)
    with pytest.raises(StoreError, match="needs about") as error:
        bench.run()
    assert "free some space" in error.value.hint
    assert bench.work_done() == [] and not bench.folder.exists()


def expected(bench: Bench) -> list[str]:
    return [line.partition(",")[0] for line in bench.remarks.lines if "estimate: " in line]


def test_estimates_follow_what_stages_took(bench: Bench) -> None:
    bench.run("count.limit=3")
    first, after_count, after_square = expected(bench)
    assert (first, after_count) == ("estimate: about 6.4 min", "new estimate: about 3.3 min")
    assert after_square == "new estimate: about 9 s", "half of 18 s: the stages take no time here"


@pytest.mark.parametrize(
    ("seconds", "compiling", "busy"), [(90.0, 0.0, True), (25.0, 90.0, False), (25.0, 0.0, False)]
)
def test_waiting_for_the_compiler_is_not_taken_for_other_programs(
    bench: Bench, seconds: float, compiling: float, busy: bool
) -> None:
    made = {outcome.stage: outcome.manifest for outcome in bench.run(until="count")}
    took = {"seconds": seconds, "compile_seconds": compiling, "cpu_seconds": 24.0}
    made = {name: manifest.model_copy(update=took) for name, manifest in made.items()}
    with DigestMemo(bench.store / "digests.json") as memo:
        runner = Runner(bench.dag, bench.settings(), Store(bench.store, memo), 1, bench.remarks)
        runner._revise(runner.plan()[1:], made, made)
    assert ("other programs are busy" in bench.remarks.lines[-1]) == busy


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_kernels_of_the_stages_to_run_are_prepared_on_the_cpu(bench: Bench, device: Device) -> None:
    prepared: list[list[str]] = []
    dag = replace(bench.dag, prepare=lambda names: prepared.append([*names]))
    for until in ("count", "square"):
        run = replace(bench.settings(), device=device)
        with DigestMemo(bench.store / "digests.json") as memo:
            Runner(dag, run, Store(bench.store, memo), 1, bench.remarks).run_until(until)
    assert prepared == ([["count"], ["square"]] if device == "cpu" else [])


def test_stages_without_work_are_not_reported(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """A draft printed "rivr: started", "new estimate: about 0 s ()" and "no repairs are made"."""
    monkeypatch.setattr(bench.dag.load("total"), "idle", lambda config: True, raising=False)
    bench.run()
    assert (bench.folder / "total").exists()
    told = [line for line in bench.remarks.lines if "total" in line or "estimate" in line]
    assert [line.partition(":")[0] for line in told] == ["estimate", "new estimate"]


def test_there_is_no_estimate_without_work() -> None:
    """The status of a finished draft ended with "estimate: about 0 s, 1.0 GB memory, 0 MB disk ()"."""
    nothing = Estimate(minutes=0.0, memory_gb=1.0, disk_gb=0.0)
    assert cost_line([StagePlan("rivr", "missing", (), nothing)]) == ""


def test_another_capture_in_the_same_run_folder_is_refused(bench: Bench, tmp_path: Path) -> None:
    bench.run()
    other = tmp_path / "other"
    shutil.copytree(bench.capture, other)
    settings = replace(bench.settings(), source=other)
    store = Store(bench.store, DigestMemo(bench.store / "digests.json"))
    check_same_input(settings, bench.dag, store)  # the same content elsewhere is the same capture
    (other / "0.txt").write_text("100")
    with pytest.raises(InputError, match="is a run of"):
        check_same_input(settings, bench.dag, store)


def test_run_inside_its_input_is_refused(bench: Bench) -> None:
    inside = replace(bench.settings(), folder=bench.capture / "run")
    store = Store(bench.store, DigestMemo(bench.store / "digests.json"))
    with pytest.raises(InputError, match="is inside the input"):
        Planner(bench.dag, inside, store, 1, bench.remarks).plan()
    at_it = replace(bench.settings(), folder=bench.capture, source=bench.capture)
    with pytest.raises(InputError, match="is the input itself"):
        Planner(bench.dag, at_it, store, 1, bench.remarks).plan()


def test_a_run_through_links_inside_its_input_is_refused(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(bench.capture)
    inside = replace(bench.settings(), folder=tmp_path / "link" / "run")
    with pytest.raises(InputError, match="is inside the input"):
        Planner(bench.dag, inside, Store(bench.store, DigestMemo(bench.store / "d")), 1, bench.remarks).plan()
    for place in (bench.capture / "store", tmp_path / "link"):
        with pytest.raises(InputError, match=r"the store .* is inside the input"):
            bench.run(store=place)
    assert bench.work_done() == [] and not (bench.capture / "store").exists()


@pytest.mark.parametrize("place", ["report", "count", "run.log", ".store/work/mine", "link"])
def test_an_input_that_the_run_would_replace_is_refused(bench: Bench, place: str, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/link").symlink_to(tmp_path / "run/report")
    own = tmp_path / "run" / ("report" if place == "link" else place)
    shutil.copytree(bench.capture, own)
    settings = replace(bench.settings(), source=tmp_path / "run" / place)
    store = Store(bench.store, DigestMemo(bench.store / "digests.sqlite"))
    with pytest.raises(InputError, match="would replace its input"):
        Runner(bench.dag, settings, store, 1, bench.remarks).run_until()
    assert len(list(own.iterdir())) == 6


def test_missing_file_of_a_late_stage_is_noticed_before_work(bench: Bench, tmp_path: Path) -> None:
    stages = {name: bench.dag.load(name) for name in bench.dag.names}
    nowhere = {"weights": tmp_path / "nowhere.onnx"}
    object.__setattr__(stages["total"], "externals", lambda config, source: nowhere)
    with pytest.raises(InputError, match=r"nowhere\.onnx"):
        bench.run()
    assert bench.work_done() == [] and not bench.folder.exists()


def test_meanings_of_columns_are_repeated_in_the_manifest(tmp_path: Path) -> None:
    """pandas, polars and duckdb drop those in the files. `table_meanings` fills ``Manifest.columns``."""
    schema = pa.schema(
        [column("weight", pa.float64(), "share of the loss, 0 to 1"), pa.field("n", pa.int32())]
    )
    (tmp_path / "part").mkdir()
    write_table(tmp_path / "part/t.parquet", pa.table({"weight": [0.5], "n": [1]}), schema)
    (tmp_path / "note.txt").write_text("not a table")
    assert table_meanings(tmp_path, ["part/t.parquet", "note.txt"]) == {
        "part/t.parquet": {"weight": "share of the loss, 0 to 1", "n": ""}
    }


def test_a_manifest_of_an_older_version_has_no_meanings(bench: Bench) -> None:
    bench.run()
    content = json.loads((bench.folder / "count" / MANIFEST).read_text())
    del content["columns"], content["seal"]
    folder = bench.folder / "older"
    folder.mkdir()
    write_json(folder / MANIFEST, {**content, "seal": json_digest(content)})
    assert read_manifest(folder).columns == {}
