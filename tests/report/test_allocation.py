"""The picture of RVA's allocation: which frames it shows, where it writes, and that they are in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest

from cleargs.capture import tables as ingest
from cleargs.errors import InputError
from cleargs.parquet import write_table
from cleargs.report.allocation_picture import (
    Allocation,
    extremes,
    load_allocation,
    place_labels,
    plot_allocation,
)
from cleargs.rva.assessment import Observations, assess, bins_table, frames_table, poses_from
from cleargs.rva.tables import BINS, FRAMES
from cleargs.stages.rva import RvaConfig

COUNT = 12
UNREGISTERED, HELD_OUT, UNSCORED = 3, 5, 7


def colour_of(k: int) -> tuple[int, int, int]:
    """The flat colour of frame k's image (BGR): none that the plot uses elsewhere."""
    return 250 - 3 * k, 190, 13 + 5 * k


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ingest and rva left of twelve flat images: good at first, then hopeless, with gaps."""
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


@pytest.fixture(scope="module")
def allocation(run: Path) -> Allocation:
    return load_allocation(run / "rva", run / "ingest")


def test_it_reads_what_the_stages_left(allocation: Allocation) -> None:
    ids = allocation.frame_id.tolist()
    assert ids == [k for k in range(COUNT) if k != HELD_OUT]
    unplaced = [k for k, placed in zip(ids, allocation.placed, strict=True) if not placed]
    assert unplaced == [UNREGISTERED, UNSCORED]
    assert np.isnan(allocation.centres[ids.index(UNREGISTERED)]).all()
    row = ids.index(UNSCORED)
    assert np.isnan([allocation.R[row], allocation.G[row]]).all()
    assert allocation.centres[row].tolist() == [3.5, 0.0, -1.75]  # -R^T t: its pose is known
    assert allocation.directions[row].tolist() == [0.0, 0.0, 1.0]
    assert set(allocation.role) == {"strong", "reactivated", "suppressed"}
    assert not allocation.covered.all()


def test_time_is_in_seconds_where_all_frames_have_one(allocation: Allocation) -> None:
    x, label = allocation.along
    assert label == "time (s)" and x[1] == 0.5
    x, label = replace(allocation, time_s=np.where(x == 1.0, np.nan, x)).along
    assert label == "frame" and x.tolist() == allocation.frame_id.tolist()


def test_extremes(allocation: Allocation) -> None:
    shown = {title: allocation.frame_id[rows].tolist() for title, rows in extremes(allocation).items()}
    # Ten frames have scores, which fall from frame to frame: the better half, and the others from the end.
    assert shown["best\nby R - B"] == [0, 1, 2, 3, 4]
    assert shown["worst\nby R - B"] == [11, 10, 9, 8, 6]
    revived = allocation.frame_id[allocation.role == "reactivated"].tolist()
    assert shown[f"reactivated\n{len(revived)} of {len(revived)}"] == revived


def many(count: int) -> Allocation:
    """A long capture whose frames get better slowly, all reactivated."""
    nothing = np.zeros((count, 3))
    R = np.linspace(0.0, 1.0, count)
    return Allocation(
        evaluator="hand-1",
        frame_id=np.arange(count),
        time_s=np.arange(count) / 30.0,
        images=[Path("nowhere")] * count,
        centres=nothing,
        directions=nothing,
        R=R,
        B=1.0 - R,
        G=R,
        bin=np.zeros(count, dtype=np.int64),
        role=np.full(count, "reactivated"),
        weight=np.full(count, 0.12),
        stand_in=np.zeros(count, dtype=bool),
        covered=np.zeros(1, dtype=bool),
    )


def test_pictures_of_a_long_capture_lie_apart() -> None:
    """The extremes of a slow change are one view over and over, unless they keep a twentieth's distance."""
    shown = extremes(many(2000), most=3)
    assert shown == {
        "best\nby R - B": [1999, 1899, 1799],
        "worst\nby R - B": [0, 100, 200],
        "reactivated\n3 of 2000": [0, 1000, 1999],
    }


def test_every_pictured_frame_is_in_the_picture(allocation: Allocation, tmp_path: Path) -> None:
    plot_allocation(tmp_path / "a.png", allocation, "twelve")
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture is not None
    pictured = {int(allocation.frame_id[row]) for rows in extremes(allocation).values() for row in rows}
    for k in range(COUNT):
        area = np.count_nonzero((picture == colour_of(k)).all(axis=-1))
        assert (area > 20_000) == (k in pictured), f"frame {k}: {area} px"  # a thumbnail has about 40,000
    plot_allocation(tmp_path / "b.png", allocation, "twelve")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rows", [[0], [0, 1], [4, 5]])
def test_few_frames_are_enough(allocation: Allocation, tmp_path: Path, rows: list[int]) -> None:
    few = replace(
        allocation,
        images=[allocation.images[row] for row in rows],
        **{
            name: getattr(allocation, name)[rows]
            for name in (
                "frame_id",
                "time_s",
                "centres",
                "directions",
                "R",
                "B",
                "G",
                "bin",
                "role",
                "weight",
            )
        },
        stand_in=np.ones(len(rows), dtype=bool),
    )
    plot_allocation(tmp_path / "few.png", few, "$few_{$")  # a name, no formula
    assert cv2.imread(str(tmp_path / "few.png")) is not None


@pytest.mark.filterwarnings("error")
def test_a_crowd_that_stands_still(allocation: Allocation, tmp_path: Path) -> None:
    crowd = replace(many(500), images=[allocation.images[0]] * 500)
    plot_allocation(tmp_path / "crowd.png", crowd, "crowd")
    assert cv2.imread(str(tmp_path / "crowd.png")) is not None


def test_without_a_trajectory_there_is_no_picture(allocation: Allocation, tmp_path: Path) -> None:
    lost = replace(allocation, bin=np.full_like(allocation.bin, -1))
    with pytest.raises(InputError, match="no frame has both"):
        plot_allocation(tmp_path / "lost.png", lost, "lost")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "anchors",
    [
        np.full((16, 2), 250.0),
        np.full((16, 2), 60.0),  # the map leaves 12 % empty on each side
        np.column_stack([np.linspace(200.0, 300.0, 16), np.full(16, 490.0)]),
    ],
    ids=["one place", "a corner", "a short line at the rim"],
)
def test_labels_stay_off_each_other_and_inside(anchors: np.ndarray) -> None:
    sizes = np.tile([[16.0, 14.0], [88.0, 14.0]], (8, 1))
    middles = place_labels(anchors, sizes, anchors, np.array([0.0, 0.0, 500.0, 500.0]))
    assert (middles - sizes / 2 >= 0.0).all() and (middles + sizes / 2 <= 500.0).all()
    for i in range(16):
        for j in range(i):
            gap = np.abs(middles[i] - middles[j]) - (sizes[i] + sizes[j]) / 2
            assert gap.max() >= 2.0, (i, j)
    again = place_labels(anchors, sizes, anchors, np.array([0.0, 0.0, 500.0, 500.0]))
    np.testing.assert_array_equal(middles, again)


def test_a_label_keeps_off_the_marks_and_near_its_own() -> None:
    marks = np.column_stack([np.linspace(100.0, 400.0, 61), np.full(61, 250.0)])  # a row from left to right
    (middle,) = place_labels(
        marks[30:31], np.array([[24.0, 14.0]]), marks, np.array([0.0, 0.0, 500.0, 500.0])
    )
    assert abs(middle[1] - 250.0) > 7.0 + 4.0
    assert np.linalg.norm(middle - marks[30]) < 40.0
