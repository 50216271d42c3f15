"""All five stages on a small synthetic capture, from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from plyfile import PlyData

from cleargs.cli.main import invoke
from cleargs.progress import SilentReporter
from cleargs.stages import STAGES
from cleargs.synth.synthetic_capture import make_capture

SETTINGS = {
    "ingest.poses": "sfm",
    "ingest.max_features": "1024",
    "g0.steps": "60",
    "g0.min_points": "1500",
    "g0.budget": "2000",
    "g0.checkpoint_interval": "10",
    "rivr.rounds": "2",
    "rivr.targets": "all",
    "rivr.keep_raw": "false",  # each frame gets a repair, so that the second round is run
    "rivr.distil.steps": "20",
    "consolidate.distil.steps": "20",
}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames without poses, half of them sharp."""
    folder = tmp_path_factory.mktemp("capture") / "room"
    make_capture(folder, "mixed", frames=8, width=320, height=180, seed=3, reporter=SilentReporter())
    return folder


def run_stages(capture: Path, run: Path, *more: str) -> None:
    settings = [part for name, value in SETTINGS.items() for part in ("--set", f"{name}={value}")]
    assert invoke(["run", str(capture), "-o", str(run), *settings, *more]) == 0


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An undisturbed run on two threads."""
    run = tmp_path_factory.mktemp("finished") / "run"
    run_stages(capture, run, "--threads", "2")
    return run


def test_every_artifact_is_there_to_inspect(finished: Path) -> None:
    frames = pq.read_table(finished / "ingest" / "frames.parquet").to_pylist()
    assert [frame["frame_id"] for frame in frames] == list(range(8))
    assert sum(frame["registered"] for frame in frames) >= 5
    rva = pq.read_table(finished / "rva" / "frames.parquet").to_pylist()
    assert len(rva) == 8 and any(row["weight"] > 0.8 for row in rva)
    selection = pq.read_table(finished / "rivr" / "selection.parquet").to_pylist()
    # One strong frame is not repaired: it is the control frame.
    targets = sum(frame["registered"] for frame in frames) - 1
    tried = [row for row in selection if row["exr"] is not None]
    assert len(tried) == 2 * targets
    for row in tried:
        assert (finished / "rivr" / row["exr"]).is_file()
    for stage in ("g0", "rivr", "consolidate"):
        vertices = PlyData.read(finished / stage / "scene.ply")["vertex"]
        assert {"x", "opacity", "scale_0", "rot_3", "f_dc_0"} <= {p.name for p in vertices.properties}
        assert 1500 <= vertices.count <= 2000


def test_an_unknown_value_in_a_table_is_null_and_never_nan(finished: Path) -> None:
    """Polars, for one, counts NaN as the largest number: it would choose unmeasured frames as the best."""
    tables = [path for stage in STAGES for path in (finished / stage).rglob("*.parquet")]
    assert len(tables) > 8
    for path in tables:
        table = pq.read_table(path)
        for name in table.column_names:
            column = table[name]
            while pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
                column = pc.list_flatten(column)
            if pa.types.is_floating(column.type):
                assert not pc.any(pc.is_nan(column)).as_py(), (path, name)


def test_the_same_command_again_does_nothing(
    capture: Path, finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = _times(finished)
    run_stages(capture, finished)
    said = capsys.readouterr().err
    assert all(f"{stage}: started" not in said for stage in STAGES)
    after = _times(finished)
    assert {path: after.get(path) for path in before} == before


def test_a_setting_redoes_only_what_reads_it(
    capture: Path, finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_stages(capture, finished, "--set", "consolidate.distil.steps=10", "--dry-run", "--json")
    states = {row["stage"]: row["state"] for row in json.loads(capsys.readouterr().out)}
    assert states == {**dict.fromkeys(STAGES, "done"), "consolidate": "outdated"}


def _times(run: Path) -> dict[Path, int]:
    """Time of the last change of each file, except those that any run may write: locks, digests, the log."""
    ignored = (".lock", "digests.json", "run.log")
    files = (path for path in run.rglob("*") if path.is_file() and not path.name.startswith(ignored))
    return {path: path.stat().st_mtime_ns for path in files}
