"""All five stages on a small synthetic capture, from the command line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from plyfile import PlyData

from cleargs.progress import SilentReporter
from cleargs.stages import STAGES
from cleargs.synth.synthetic_capture import make_capture

COMMAND = [sys.executable, "-c", "from cleargs.cli.main import main; main()"]
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


def command(capture: Path, run: Path, *more: str) -> list[str]:
    settings = [part for name, value in SETTINGS.items() for part in ("--set", f"{name}={value}")]
    return [*COMMAND, "run", str(capture), "-o", str(run), *settings, *more]


def finish(capture: Path, run: Path, *more: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(command(capture, run, *more), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An undisturbed run on two threads."""
    run = tmp_path_factory.mktemp("finished") / "run"
    finish(capture, run, "--threads", "2")
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


def test_the_same_command_again_does_nothing(capture: Path, finished: Path) -> None:
    before = _times(finished)
    done = finish(capture, finished)
    assert all(f"{stage}: started" not in done.stderr for stage in STAGES)
    after = _times(finished)
    assert {path: after.get(path) for path in before} == before


def test_a_setting_redoes_only_what_reads_it(capture: Path, finished: Path) -> None:
    done = finish(capture, finished, "--set", "consolidate.distil.steps=10", "--dry-run", "--json")
    states = {row["stage"]: row["state"] for row in json.loads(done.stdout)}
    assert states == {**dict.fromkeys(STAGES, "done"), "consolidate": "outdated"}


def _times(run: Path) -> dict[Path, int]:
    """Time of the last change of each file, except those that any run may write: locks, digests, the log."""
    ignored = (".lock", "digests.json", "run.log")
    files = (path for path in run.rglob("*") if path.is_file() and not path.name.startswith(ignored))
    return {path: path.stat().st_mtime_ns for path in files}
