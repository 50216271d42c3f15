"""The stage: from an ingest folder to its two tables, and its settings."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest
from pydantic import ValidationError

from cleargs.capture import tables as ingest
from cleargs.parquet import read_table, write_table
from cleargs.pipeline.stage import StageContext
from cleargs.progress import SilentReporter
from cleargs.rva.tables import BINS, FRAMES
from cleargs.stages.rva import RvaConfig

DESIGN_COLUMNS = [
    "frame_id",
    "name",
    "evaluator",
    "r_sharpness",
    "r_structure",
    "r_texture",
    "r_cleanness",
    "r_exposure",
    "b_motion_blur",
    "b_defocus",
    "b_ghosting",
    "b_exposure_failure",
    "b_unreliable_texture",
    "b_artifacts",
    "R",
    "B",
    "reliable",
    "C",
    "D",
    "O",
    "G",
    "bin",
    "Z",
    "role",
    "weight",
]

BLURRED, UNREGISTERED, HELD_OUT = 2, 4, 6


@pytest.fixture(scope="module")
def ingest_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames of a textured wall: one blurred, one without a pose, one held out."""
    folder = tmp_path_factory.mktemp("capture") / "ingest"
    (folder / "images").mkdir(parents=True)
    rng = np.random.default_rng(1)
    wall = cv2.resize(
        rng.integers(20, 230, (40, 60), dtype=np.uint8), (240, 160), interpolation=cv2.INTER_NEAREST
    )
    rows = []
    for k in range(8):
        image = cv2.blur(wall, (15, 15)) if k == BLURRED else wall
        cv2.imwrite(str(folder / "images" / f"{k:06d}.png"), image)
        pose = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "tx": -0.1 * k, "ty": 0.0, "tz": 0.0}
        rows.append(
            {
                "frame_id": k,
                "name": f"{k}.jpg",
                "image": f"images/{k:06d}.png",
                "time_s": None,
                "width": 240,
                "height": 160,
                "fx": 200.0,
                "fy": 200.0,
                "cx": 120.0,
                "cy": 80.0,
                **(dict.fromkeys(pose) if k == UNREGISTERED else pose),
                "registered": k != UNREGISTERED,
                "n_points": 10,
                "split": "test" if k == HELD_OUT else "train",
            }
        )
    write_table(folder / "frames.parquet", pa.Table.from_pylist(rows, schema=ingest.FRAMES), ingest.FRAMES)
    frames = np.repeat(np.arange(8, dtype=np.int32), 10)
    points = (frames * 3 + np.tile(np.arange(10), 8)).astype(np.int64)
    observations = pa.table({"frame_id": frames, "point_id": points}, schema=ingest.OBSERVATIONS)
    write_table(folder / "observations.parquet", observations, ingest.OBSERVATIONS)
    write_table(folder / "points.parquet", ingest.POINTS.empty_table(), ingest.POINTS)
    return folder


def run(ingest_dir: Path, out: Path, config: RvaConfig, threads: int = 1) -> dict[str, object]:
    out.mkdir()
    context = StageContext(
        config=config,
        source=ingest_dir,
        inputs={"ingest": ingest_dir},
        externals={},
        out=out,
        checkpoints=out,
        cache=out / "kept",
        seed=0,
        device="cpu",
        threads=threads,
        reporter=SilentReporter(),
    )
    result = import_module("cleargs.stages.rva").run(context)
    assert result.missing == ()
    return dict(result.summary)


def test_tables_of_a_small_capture(ingest_dir: Path, tmp_path: Path) -> None:
    summary = run(ingest_dir, tmp_path / "rva", RvaConfig())
    table = read_table(tmp_path / "rva" / "frames.parquet", FRAMES)
    assert table.column_names == [*DESIGN_COLUMNS, "fallback", "reactivated_for"]
    rows = {row["frame_id"]: row for row in table.to_pylist()}
    assert sorted(rows) == [0, 1, 2, 3, 4, 5, 7]  # the held-out frame has no row
    assert rows[UNREGISTERED]["G"] is None
    assert rows[UNREGISTERED]["role"] == "suppressed"
    assert rows[BLURRED]["R"] < 0.70
    assert {rows[k]["role"] for k in (0, 1, 3, 5, 7)} == {"strong"}
    assert rows[0]["evaluator"] == "statistics-2"
    assert summary["reliable"] == 5
    bins = read_table(tmp_path / "rva" / "bins.parquet", BINS).to_pylist()
    assert sum(row["n_frames"] for row in bins) == 6


def test_equal_bytes_for_any_number_of_threads(ingest_dir: Path, tmp_path: Path) -> None:
    for threads in (1, 2):
        run(ingest_dir, tmp_path / str(threads), RvaConfig(), threads)
    for name in ("frames.parquet", "bins.parquet"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def test_a_broken_image_is_named(ingest_dir: Path, tmp_path: Path) -> None:
    from cleargs.errors import StoreError
    from cleargs.rva.evaluator import EvaluatedFrame
    from cleargs.rva.evaluators import make_evaluator

    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no image")
    with pytest.raises(StoreError, match=r"broken\.png"):
        make_evaluator(RvaConfig()).evaluate(
            [EvaluatedFrame(0, broken)], threads=1, reporter=SilentReporter()
        )


@pytest.mark.parametrize(
    "changes",
    [
        {"tau_R": 1.2},
        {"w_R": (0.5, 0.5, 0.5, 0.0, 0.0)},
        {"gamma_c": 0.9},
        {"strong_base": 0.9},
        {"frames_per_bin": 0},
        {"evaluator": "oracle"},
        {"tau": 0.7},
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        RvaConfig(**changes)
