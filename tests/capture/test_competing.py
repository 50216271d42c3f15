"""Captures in which two motions compete: a turntable before a still room, and a stabiliser."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from cleargs.capture.behind import still_room
from cleargs.capture.colmap import pycolmap
from cleargs.capture.second_motion import second_motion
from cleargs.capture.tables import load_frames
from cleargs.cli.main import invoke
from cleargs.media.image import read_rgb
from cleargs.synth.room import make_room
from cleargs.synth.synthetic_capture import make_capture

from .conftest import Ingest
from .filmed import film, stabilised, text_wall, turntable, walk, write


@pytest.mark.slow
def test_what_turns_before_a_still_room_is_reconstructed(tmp_path: Path, ingest: Ingest) -> None:
    done = ingest(write(tmp_path / "in", turntable(2, 30)))
    summary = done.result.summary
    assert summary["registered"] == 30
    assert summary["cameras"][0]["focal_px"] == pytest.approx(251, rel=0.1)
    assert any("two motions" in warning for warning in done.warnings)
    masked = [np.mean(read_rgb(path) == 0) for path in sorted((done.out / "masks").iterdir())]
    assert len(masked) == 30 and 0.4 < np.mean(masked) < 0.9


@pytest.mark.parametrize("frames", [8, 12])
def test_a_walk_has_no_still_room(tmp_path: Path, frames: int) -> None:
    folder = write(tmp_path / "in", film(make_room(3), walk(3, frames), size=(160, 120)))
    assert still_room(sorted(folder.iterdir())) is None


def test_the_room_around_a_turntable_is_masked_and_the_things_are_not(tmp_path: Path) -> None:
    folder = write(tmp_path / "in", turntable(4, 10, (160, 120)))
    room = still_room(sorted(folder.iterdir()))
    assert room is not None and room.share > 0.5
    masks = np.stack([room.mask(read_rgb(path)) for path in sorted(folder.iterdir())])
    assert (masks[:, :30] == 0).mean() > 0.6 and (masks[:, 55:70, 50:110] == 255).mean() > 0.6


@pytest.mark.slow
def test_a_walk_before_a_wall_of_text_that_scrolls_is_done_in_part(tmp_path: Path, ingest: Ingest) -> None:
    """The centres are 39 % off, and 83 % of the kept-out keypoints are within 2 px."""
    pictures = text_wall(14, 18, (240, 180), speed=12)
    (missing,) = ingest(write(tmp_path / "in", pictures), max_features=1000).result.missing
    assert "moves by itself" in missing and "mask what moves" in missing


@pytest.mark.slow
def test_the_demo_has_no_second_motion(tmp_path: Path) -> None:
    """Its cameras are right. Its posters repeat and half of its frames are blurred: 89 %, 29 % of pairs."""
    make_capture(tmp_path / "demo", "mixed", frames=16, width=480, height=270, seed=0)
    options = ["--recipe", "smoke", "--set", "ingest.poses=sfm", "--until", "ingest", "--no-report"]
    assert invoke(["run", str(tmp_path / "demo"), "-o", str(tmp_path / "run"), *options]) == 0


@pytest.mark.slow
def test_a_stabiliser_is_named_and_undone(tmp_path: Path, ingest: Ingest) -> None:
    """Without shifts per frame the centres are 2.5 % off, with them 0.4 %."""
    done = ingest(write(tmp_path / "in", stabilised(2, 16)))
    assert any("stabilised" in warning for warning in done.warnings)
    frames = load_frames(done.out)
    assert all(frame.registered for frame in frames)
    random = np.random.default_rng(2)
    true = np.stack([0.04 * random.uniform(-1, 1, 2) * 320 for _ in frames])
    found = np.array([[frame.cx / frame.width, frame.cy / frame.height] for frame in frames]) * [320, 240]
    assert np.corrcoef((true - true.mean(0)).ravel(), (found - found.mean(0)).ravel())[0, 1] > 0.9


def filmed_matches(database: Path, moving: int) -> pycolmap.Reconstruction:
    """Return 8 cameras in an arc. ``database`` gets matches of 100 points, and of ``moving`` more on a wall.

    The latter move up by 0.2 per frame; the wall is 6 away, and the focal length is 200 px.
    """
    random = np.random.default_rng(0)
    still = random.uniform([-2.0, -1.5, 4.0], [2.0, 1.5, 7.0], (100, 3))
    wall = np.column_stack([random.uniform(-2.0, 2.0, (moving, 2)), np.full(moving, 6.0)])
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 200.0, 240, 180)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    with pycolmap.Database.open(database) as opened:
        opened.write_camera(camera, use_camera_id=True)
        for key in range(1, 9):
            pose = pycolmap.Rigid3d(np.column_stack([np.eye(3), [-0.2 * key, 0.02 * (key - 4) ** 2, 0.0]]))
            image = pycolmap.Image(name=f"{key}.png", camera_id=1, image_id=key)
            model.add_image_with_trivial_frame(image, pose)
            opened.write_image(image, use_image_id=True)
            seen = np.concatenate([still, wall - [0.0, 0.2 * key, 0.0]]) + pose.translation
            opened.write_keypoints(key, np.asarray(camera.img_from_cam(seen), np.float32))
        rows = np.repeat(np.arange(100 + moving, dtype=np.uint32)[:, None], 2, axis=1)
        for one, two in combinations(range(1, 9), 2):
            opened.write_matches(one, two, rows)
    return model


def test_a_part_of_the_pictures_that_moves_by_itself_is_seen(tmp_path: Path) -> None:
    assert second_motion(filmed_matches(tmp_path / "still.db", 0), tmp_path / "still.db") == 0
    assert second_motion(filmed_matches(tmp_path / "moving.db", 30), tmp_path / "moving.db") > 0.8


def test_wrong_matches_that_contradict_each_other_are_no_second_motion(tmp_path: Path) -> None:
    model = filmed_matches(tmp_path / "matches.db", 30)
    random = np.random.default_rng(1)
    with pycolmap.Database.open(tmp_path / "matches.db") as opened:
        for one, two in combinations(range(1, 9), 2):
            rows = opened.read_matches(one, two)
            rows[100:, 1] = random.permutation(rows[100:, 1])
            opened.delete_matches(one, two)
            opened.write_matches(one, two, rows)
    assert second_motion(model, tmp_path / "matches.db") == 0


def test_frames_in_a_wrong_place_contradict_matches_that_agree(tmp_path: Path) -> None:
    model = filmed_matches(tmp_path / "matches.db", 0)
    away = pycolmap.Rigid3d(np.column_stack([np.eye(3), [0.0, 1.5, 0.0]]))
    model.frames[model.images[4].frame_id].rig_from_world = away
    assert 0.1 < second_motion(model, tmp_path / "matches.db") < 0.5
