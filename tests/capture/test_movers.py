"""Things in frames that may move: masks of features, and boxes in the published images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cleargs.capture.cameras import Intrinsics
from cleargs.capture.capture import SourceFrame
from cleargs.capture.movers import Boxes, with_movers
from cleargs.capture.prepare import WorkFrame
from cleargs.capture.tables import load_frames
from cleargs.capture.undistort import undistorter
from cleargs.models import detector, registry
from cleargs.progress import SilentReporter
from cleargs.scene.views import view_of
from cleargs.types import ImageU8

from .conftest import HEIGHT, WIDTH, Ingest

PERSON: Boxes = [("person", 40, 60, 100, 200)]


def work_frames(folder: Path, count: int = 8) -> list[WorkFrame]:
    """Pictures whose number is their brightness."""
    (folder / "images").mkdir()
    frames = []
    for k in range(count):
        name = f"{k:06d}.png"
        cv2.imwrite(str(folder / "images" / name), np.full((HEIGHT, WIDTH, 3), k, np.uint8))
        frames.append(WorkFrame(SourceFrame(name, folder / name), name, WIDTH, HEIGHT, False, None))
    return frames


def test_features_are_left_out_where_somebody_passes(tmp_path: Path) -> None:
    def boxes(image: ImageU8) -> Boxes:
        return PERSON if image.max() in (2, 3) else []

    marked = with_movers(work_frames(tmp_path), tmp_path, boxes, SilentReporter())
    assert [frame.movers for frame in marked] == [()] * 2 + [((40, 60, 100, 200),)] * 2 + [()] * 4
    masks = [cv2.imread(str(tmp_path / "features" / f"{frame.image}.png"), 0) for frame in marked]
    assert not masks[2][60:200, 40:100].any() and (masks[2] > 0).sum() == HEIGHT * WIDTH - 140 * 60
    assert (masks[0] > 0).all()


def test_a_kind_that_most_frames_show_is_the_subject(tmp_path: Path) -> None:
    def boxes(image: ImageU8) -> Boxes:
        return PERSON if image.max() != 3 else [*PERSON, ("screen", 0, 0, 50, 50)]

    marked = with_movers(work_frames(tmp_path), tmp_path, boxes, SilentReporter())
    assert [frame.movers for frame in marked] == [()] * 3 + [((0, 0, 50, 50),)] + [()] * 4


def test_a_frame_of_boxes_keeps_its_features(tmp_path: Path) -> None:
    whole: Boxes = [("animal", 0, 0, WIDTH, HEIGHT - 20)]
    marked = with_movers(
        work_frames(tmp_path), tmp_path, lambda image: whole if image.max() == 5 else [], SilentReporter()
    )
    assert marked[5].movers
    assert (cv2.imread(str(tmp_path / "features" / "000005.png.png"), 0) > 0).all()


def test_a_box_moves_with_the_distortion() -> None:
    lens = Intrinsics("SIMPLE_RADIAL", WIDTH, HEIGHT, (300.0, WIDTH / 2, HEIGHT / 2, -0.2))
    flat = undistorter(lens, WIDTH)
    spot = np.zeros((HEIGHT, WIDTH), np.uint8)
    spot[30:80, 20:70] = 255
    rows, columns = np.nonzero(flat.mask(spot))
    box = flat.box((20, 30, 70, 80))
    ends = box["left"], box["top"], box["right"], box["bottom"]
    inside = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    np.testing.assert_allclose(ends, inside, atol=2)


@pytest.mark.parametrize("seen", [True, False])
def test_the_boxes_are_published(
    posed: Path, ingest: Ingest, monkeypatch: pytest.MonkeyPatch, seen: bool
) -> None:
    class Tiny:
        def boxes(self, image: ImageU8) -> Boxes:
            return PERSON if seen and np.array_equal(image, first) else []

    first = cv2.cvtColor(cv2.imread(str(min((posed / "images").iterdir()))), cv2.COLOR_BGR2RGB)
    before = ingest(posed, "before")
    assert not (before.out / "movers.parquet").exists()
    assert {frame.movers for frame in load_frames(before.out)} == {None}
    monkeypatch.setattr(registry, "installed_files", lambda name: {name: Path(name)})
    monkeypatch.setattr(detector, "load_detector", Tiny)
    frames = load_frames(ingest(posed, "after").out)
    assert all(frame.movers == () for frame in frames[1:])
    assert view_of(frames[0], before.out, 1.0).movers == (((40, 60, 100, 200),) if seen else ())
