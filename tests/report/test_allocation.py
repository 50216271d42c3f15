"""The picture of RVA's allocation, and its choice of frames."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pytest

from cleargs.capture import tables as ingest
from cleargs.errors import InputError
from cleargs.parquet import read_table, write_table
from cleargs.report.allocation_picture import Row, extreme_frames, plot_allocation
from cleargs.rva.assessment import Observations, assess, bins_table, frames_table, poses_from
from cleargs.rva.tables import BINS, FRAMES
from cleargs.stages.rva import RvaConfig

COUNT = 12
UNREGISTERED, HELD_OUT, UNSCORED = 3, 5, 7


def colour_of(k: int) -> tuple[int, int, int]:
    """The flat colour of frame k's image (BGR), which the plot does not use elsewhere."""
    return 250 - 3 * k, 190, 13 + 5 * k


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of ingest and rva for twelve flat images: first good, then bad, with gaps."""
    root = tmp_path_factory.mktemp("run")
    (root / "ingest" / "images").mkdir(parents=True)
    (root / "rva").mkdir()
    rows = []
    for k in range(COUNT):
        cv2.imwrite(
            str(root / "ingest" / f"images/{k:06d}.png"), np.full((60, 80, 3), colour_of(k), np.uint8)
        )
        pose = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "tx": -0.5 * k, "ty": 0.0, "tz": 0.25 * k}
        rows.append(
            {
                "frame_id": k,
                "name": f"{k}.jpg",
                "image": f"images/{k:06d}.png",
                "time_s": 0.5 * k,
                **{"width": 80, "height": 60, "fx": 70.0, "fy": 70.0, "cx": 40.0, "cy": 30.0},
                **(dict.fromkeys(pose) if k == UNREGISTERED else pose),
                "registered": k != UNREGISTERED,
                "n_points": 0,
                "split": "test" if k == HELD_OUT else "train",
            }
        )
    table = pa.Table.from_pylist(rows, schema=ingest.FRAMES)
    write_table(root / "ingest" / "frames.parquet", table, ingest.FRAMES)
    frames = [frame for frame in ingest.load_frames(root / "ingest") if frame.split == "train"]
    frame_id = np.array([frame.frame_id for frame in frames], dtype=np.int32)
    good = np.where(frame_id < COUNT / 2, 0.9, 0.1) - 0.005 * frame_id
    cues = np.hstack([np.repeat(good[:, None], 5, axis=1), np.repeat(1.0 - good[:, None], 6, axis=1)])
    cues[frame_id == UNSCORED] = np.nan
    nothing = Observations(np.zeros(0, np.int32), np.zeros(0, np.int64))
    result = assess(frame_id, cues, poses_from(frames), nothing, RvaConfig(frames_per_bin=2))
    names = [frame.name for frame in frames]
    write_table(
        root / "rva" / "frames.parquet", frames_table(frame_id, names, "hand-1", cues, result), FRAMES
    )
    write_table(root / "rva" / "bins.parquet", bins_table(frame_id, result), BINS)
    return root


def rows_of(run: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = read_table(run / "rva" / "frames.parquet", FRAMES).to_pylist()
    return rows


def ids(shown: dict[str, list[Row]]) -> dict[str, list[int]]:
    return {title: [row["frame_id"] for row in rows] for title, rows in shown.items()}


def keep(run: Path, folder: Path, count: int, **changes: Any) -> Path:
    """A copy of ``run`` with only its first frames, and with ``changes`` in all rows."""
    shutil.copytree(run, folder)
    rows = [row | changes for row in rows_of(run)[:count]]
    write_table(folder / "rva" / "frames.parquet", pa.Table.from_pylist(rows, FRAMES), FRAMES)
    return folder


def plot(path: Path, run: Path, title: str = "twelve") -> None:
    plot_allocation(path, run / "rva", run / "ingest", title)


def test_extreme_frames(run: Path) -> None:
    rows = rows_of(run)
    shown = ids(extreme_frames(rows))
    # Ten frames have scores, which decrease over time: the better half, and the others from the end.
    assert shown["best by R - B"] == [0, 1, 2, 3, 4]
    assert shown["worst by R - B"] == [11, 10, 9, 8, 6]
    revived = [row["frame_id"] for row in rows if row["role"] == "reactivated"]
    assert revived and shown[f"reactivated: {len(revived)} of {len(revived)}"] == revived


def test_frames_of_a_long_capture_are_apart() -> None:
    """Without the distance of a twentieth, the extremes of a slow change would all show the same view."""
    rows = [{"frame_id": k, "R": k / 2000, "B": 1 - k / 2000, "role": "reactivated"} for k in range(2000)]
    assert ids(extreme_frames(rows, most=3)) == {
        "best by R - B": [1999, 1899, 1799],
        "worst by R - B": [0, 100, 200],
        "reactivated: 3 of 2000": [0, 1000, 1999],
    }


def test_every_pictured_frame_is_in_the_picture(run: Path, tmp_path: Path) -> None:
    plot(tmp_path / "a.png", run)
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture is not None
    pictured = {frame for frames in ids(extreme_frames(rows_of(run))).values() for frame in frames}
    for k in range(COUNT):
        area = np.count_nonzero((picture == colour_of(k)).all(axis=-1))
        assert (area > 20_000) == (k in pictured), f"frame {k}: {area} px"  # a thumbnail has about 100,000
    plot(tmp_path / "b.png", run)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_frames_are_enough(run: Path, tmp_path: Path, count: int) -> None:
    few = keep(run, tmp_path / "few", count, stand_in=True)
    plot(tmp_path / "few.png", few, "$few_{$")  # a name, not a formula
    assert cv2.imread(str(tmp_path / "few.png")) is not None


def test_without_a_trajectory_there_is_no_picture(run: Path, tmp_path: Path) -> None:
    lost = keep(run, tmp_path / "lost", COUNT, bin=None)
    with pytest.raises(InputError, match="no frame has both"):
        plot(tmp_path / "lost.png", lost)
    assert not (tmp_path / "lost.png").exists()
