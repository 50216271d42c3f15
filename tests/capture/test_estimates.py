"""Expected cost of a run before anything of it exists."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cleargs.digest import DigestMemo
from cleargs.errors import InputError
from cleargs.media.image import image_size
from cleargs.pipeline.config import load_config
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import RunSpec
from cleargs.pipeline.stage import Estimate
from cleargs.pipeline.stages import installed
from cleargs.pipeline.store import Store
from cleargs.progress import SilentReporter


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(20):
        cv2.imwrite(str(folder / f"{number}.jpg"), np.zeros((600, 800, 3), np.uint8))
    return folder


def costs(source: Path, *overrides: str, threads: int = 2) -> dict[str, Estimate]:
    store = source.parent / "store"
    run = RunSpec(source.parent / "run", source, load_config(installed(), "default", overrides), store, "cpu")
    with DigestMemo(source.parent / "memo") as memo:
        planner = Planner(installed(), run, Store(store, memo), threads, SilentReporter())
        return {plan.stage: plan.estimate for plan in planner.plan() if plan.estimate is not None}


def test_size_and_number_of_frames_come_from_the_files(photos: Path) -> None:
    plain = costs(photos)
    assert plain["ingest"].frames == 20 and plain["ingest"].megapixels == 0.48
    small = costs(photos, "ingest.max_size=400")
    assert small["ingest"].megapixels == 0.12
    # A part of each step's cost does not depend on the number of pixels.
    assert 0.25 < small["rivr"].minutes / plain["rivr"].minutes < 0.45
    # Scenes that start from the maximum number of Gaussians: candidates and Gaussians take a quarter. 2.4
    # megapixels have more Gaussians than the least number.
    large, full = (costs(photos, "g0.min_points=400_000", *size) for size in (["ingest.max_size=400"], []))
    assert large["rivr"].disk_gb / full["rivr"].disk_gb == pytest.approx(0.25, rel=0.05)
    # Growth from few points ends below the maximum of the plain capture.
    assert small["rivr"].disk_gb < plain["rivr"].disk_gb < full["rivr"].disk_gb
    assert small["g0"].minutes < plain["g0"].minutes
    # Two frames are repaired in either, by default.
    few, many = (costs(photos, "rivr.targets=all", f"ingest.max_frames={n}") for n in (10, 20))
    assert few["ingest"].frames == 10 and few["rivr"].minutes < many["rivr"].minutes


def test_scoring_and_the_first_scene_follow_the_capture_too(photos: Path) -> None:
    plain, small = costs(photos), costs(photos, "ingest.max_size=400")
    assert small["rva"].minutes == pytest.approx(plain["rva"].minutes / 4)
    # A scene starts from the sparse points, of which frames leave many before anything is known of them.
    least = {
        points: costs(photos, "g0.budget=90_000", f"g0.min_points={points}") for points in (1, 3000, 10_000)
    }
    assert least[1]["g0"].minutes == least[3000]["g0"].minutes < least[10_000]["g0"].minutes


def test_threads_count(photos: Path) -> None:
    one, two, eight = (costs(photos, threads=threads) for threads in (1, 2, 8))
    for stage in ("ingest", "g0", "rivr", "consolidate"):
        assert one[stage].minutes > two[stage].minutes > eight[stage].minutes > two[stage].minutes / 4


def test_the_size_of_an_image_is_read_from_its_header(photos: Path) -> None:
    assert image_size(photos / "3.jpg") == (800, 600)
    data = (photos / "3.jpg").read_bytes()
    (photos / "cut.jpg").write_bytes(data[: len(data) // 2])
    assert image_size(photos / "cut.jpg") == (800, 600), "the pixels are not looked at"
    (photos / "none.jpg").write_bytes(b"no image")
    with pytest.raises(InputError, match="not an image"):
        image_size(photos / "none.jpg")
