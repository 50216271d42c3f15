"""Cameras that turn, zoom or show one flat surface are refused; walks are not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cleargs.capture.colmap import pycolmap
from cleargs.capture.config import SfmConfig
from cleargs.capture.parallax import LITTLE_BELOW, depth_share, pairs_with_depth
from cleargs.capture.sfm import _require_registered
from cleargs.capture.sfm_job import SfmOutcome
from cleargs.errors import StageError
from cleargs.synth.optics import Lens, phone_lens
from cleargs.synth.room import make_room
from cleargs.types import ArrayF64, ImageU8

from .conftest import Ingest, texture
from .filmed import along_wall, film, pan, walk, write, zoomed

SIZE = (240, 180)
LENS = phone_lens(*SIZE)


def flat(poses: ArrayF64, lens: Lens = LENS) -> list[ImageU8]:
    """Return pictures of a wall of 6 x 6 metres with one texture."""
    print_, k = texture(4, 1024), np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    wall = np.array([[6 / 1024, 0, -3], [0, -6 / 1024, 4.5], [0, 0, -2.25], [0, 0, 1.0]])
    pictures = []
    for pose in poses:
        from_world = np.linalg.inv(np.vstack([pose, [0, 0, 0, 1]]))[:3]
        picture = cv2.warpPerspective(
            print_, k @ from_world @ wall, (lens.width, lens.height), flags=cv2.INTER_AREA
        )
        pictures.append(np.asarray(picture, np.uint8))
    return pictures


def bent(pictures: list[ImageU8], k1: float) -> list[ImageU8]:
    """Return the pictures through a lens that bends lines."""
    k = np.array([[LENS.fx, 0, LENS.cx], [0, LENS.fy, LENS.cy], [0, 0, 1]])
    return [np.asarray(cv2.undistort(picture, k, np.array([k1, 0, 0, 0])), np.uint8) for picture in pictures]


def refused(ingest: Ingest, source: Path) -> None:
    with pytest.raises(StageError, match="no depth") as caught:
        ingest(source)
    assert "move, do not only turn" in str(caught.value.hint)


@pytest.mark.parametrize("kind", ["wall", "pan", "zoom", "bent"])
def test_a_flat_scene_is_refused(tmp_path: Path, ingest: Ingest, kind: str) -> None:
    turned = pan(10, 50, np.array([0.0, 1.4, -0.4]))
    pictures = flat(along_wall(10) if kind == "wall" else turned)
    if kind == "zoom":
        still = pan(10, 1.0, np.array([0.0, 1.4, 0.0]))
        pictures = [flat(still[n : n + 1], zoomed(LENS, 1 + 0.08 * n))[0] for n in range(10)]
    refused(ingest, write(tmp_path / "in", bent(pictures, 0.15) if kind == "bent" else pictures))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pan", "zoom"])
def test_a_room_that_is_seen_from_one_spot_is_refused(tmp_path: Path, ingest: Ingest, kind: str) -> None:
    turned = pan(10, 60, tilt=8) if kind == "pan" else pan(10, 1)
    lenses = [zoomed(LENS, 1 + 0.08 * n) if kind == "zoom" else LENS for n in range(10)]
    refused(ingest, write(tmp_path / "in", film(make_room(2), turned, lenses)))


@pytest.mark.slow
def test_a_pan_whose_camera_trembles_is_refused(tmp_path: Path, ingest: Ingest) -> None:
    """A tremble of 1 cm shows depth in a tenth of the pairs, and half of the frames are placed wrongly."""
    trembled = pan(10, 60, tilt=8)
    trembled[:, :, 3] += np.random.default_rng(0).normal(0, 0.01 / np.sqrt(3), (10, 3))
    with pytest.raises(StageError) as caught:
        ingest(write(tmp_path / "in", film(make_room(2), trembled, [LENS] * 10)))
    assert "move, do not only turn" in str(caught.value.hint).lower()


def test_few_frames_are_enough_only_with_depth() -> None:
    _require_registered(6, 14, SfmConfig(), SfmOutcome())
    with pytest.raises(StageError, match="only 6 of 14") as caught:
        _require_registered(6, 14, SfmConfig(), SfmOutcome(little_depth=True))
    assert "move, do not only turn" in str(caught.value.hint).lower()


@pytest.mark.slow
def test_a_walk_with_a_pan_passes_and_the_pan_is_placed(tmp_path: Path, ingest: Ingest) -> None:
    steps = walk(2, 14)
    turns = [
        cv2.Rodrigues(np.array([0, np.radians(degrees), 0]))[0] for degrees in (8, 16, 24, 32, 24, 16, 8)
    ]
    panned = [np.concatenate([steps[6, :, :3] @ turn, steps[6, :, 3:]], 1) for turn in turns]
    poses = np.stack([*steps[:7], *panned, *steps[7:]])
    done = ingest(write(tmp_path / "in", film(make_room(2), poses, [LENS] * len(poses))))
    assert done.result.summary["registered"] == len(poses)


def test_a_walk_whose_distant_views_share_one_wall_only_shows_depth(tmp_path: Path) -> None:
    """In two rooms of six, filmed with 24 frames, the pairs with the largest motion showed no depth."""
    random = np.random.default_rng(0)
    wall = np.column_stack([random.uniform(-2, 6, 900), random.uniform(-1.2, 1.2, 900), np.full(900, 4.0)])
    things = np.column_stack([random.uniform(-1, 5, 300), random.uniform(-0.5, 0.5, 300), np.full(300, 2.0)])
    points = np.concatenate([wall, things])
    with pycolmap.Database.open(tmp_path / "matches.db") as opened:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 200, 240, 180)
        opened.write_camera(camera, use_camera_id=True)
        seen = []
        for key in range(1, 11):
            image = pycolmap.Image(name=f"{key}.png", camera_id=1, image_id=key)
            opened.write_image(image, use_image_id=True)
            place = points - [0.3 * key, 0, 0]
            xy = 200 * place[:, :2] / place[:, 2:] + [120, 90]
            inside = np.flatnonzero(((xy > 0) & (xy < [240, 180])).all(axis=1))
            opened.write_keypoints(key, xy[inside].astype(np.float32))
            seen.append({int(point): row for row, point in enumerate(inside)})
        for one in range(10):
            for two in range(one + 1, min(one + 4, 10)):
                most = len(points) if two == one + 1 else len(wall)
                common = [point for point in seen[one] if point in seen[two] and point < most]
                rows = np.array([[seen[one][point], seen[two][point]] for point in common], np.uint32)
                geometry = pycolmap.TwoViewGeometry(inlier_matches=rows)
                opened.write_two_view_geometry(one + 1, two + 1, geometry)
    deep, judged = pairs_with_depth(tmp_path / "matches.db")
    assert judged >= 12 and deep >= 0.3 * judged
    assert depth_share(tmp_path / "matches.db") > LITTLE_BELOW
