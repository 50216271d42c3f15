"""Cameras that turn, zoom or show one flat surface are refused; walks are not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

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
def test_a_walk_with_a_pan_passes_and_the_pan_is_placed(tmp_path: Path, ingest: Ingest) -> None:
    steps = walk(2, 14)
    turns = [
        cv2.Rodrigues(np.array([0, np.radians(degrees), 0]))[0] for degrees in (8, 16, 24, 32, 24, 16, 8)
    ]
    panned = [np.concatenate([steps[6, :, :3] @ turn, steps[6, :, 3:]], 1) for turn in turns]
    poses = np.stack([*steps[:7], *panned, *steps[7:]])
    done = ingest(write(tmp_path / "in", film(make_room(2), poses, [LENS] * len(poses))))
    assert done.result.summary["registered"] == len(poses)
