"""Synthetic captures: exact geometry, stated faults, and the same bytes for the same seed."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from cleargs.errors import InputError
from cleargs.progress import SilentReporter
from cleargs.synth.capture import make_capture
from cleargs.synth.path import exposure_poses, look_at, make_path
from cleargs.synth.protocols import PROTOCOLS, degradations
from cleargs.synth.raycast import Passes, cast
from cleargs.synth.room import DEPTH, SPHERE, Room, make_room

SIZE = {"width": 96, "height": 54}


def make(folder: Path, protocol: str = "mixed", frames: int = 4, seed: int = 0) -> Path:
    make_capture(folder, protocol, frames=frames, seed=seed, reporter=SilentReporter(), **SIZE)
    return folder


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def sharpness(path: Path) -> float:
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.float64)
    return float(np.var(cv2.Laplacian(grey, cv2.CV_64F)))


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("synth") / "mixed", frames=8)


def test_equal_seeds_give_equal_bytes_and_others_do_not(tmp_path: Path) -> None:
    first, second = make(tmp_path / "a", frames=2), make(tmp_path / "b", frames=2)
    other = make(tmp_path / "c", frames=2, seed=1)
    assert files(first) == files(second)
    assert files(first)["images/000000.png"] != files(other)["images/000000.png"]


def test_depth_and_position_of_a_ball_are_exact() -> None:
    room = make_room(0)
    ball = room.primitives[room.primitives["kind"] == SPHERE][:1].copy()
    ball["centre"], ball["size"], ball["bound"] = (0.3, 1.2, -1.0), (0.2, 0, 0), 0.2
    room = Room(np.concatenate([room.primitives[:1], ball]), room.textures, room.light, room.focus)
    eye, target = np.array([0.0, 1.2, 1.5]), np.array([0.0, 1.2, -1.0])
    pose = look_at(eye, target)
    poses = np.broadcast_to(pose, (1, 41, 3, 4)).copy()
    passes = Passes(poses, np.full((1, 2), 0.5), np.zeros((1, 2)), 1.0)
    _, depth = cast(room, passes, (100.0, 100.0, 20.5, 20.5), 41, 41)
    # Straight ahead the back wall; the ball's axis is 0.3 m to the right at 2.5 m: 12 px beside the centre.
    assert depth[20, 20] == pytest.approx(1.5 + DEPTH / 2, abs=1e-9)
    ray = np.array([0.12, 0, 1]) / np.hypot(0.12, 1)
    to_ball = np.array([0.3, 0, 2.5])
    along = ray @ to_ball
    distance = along - np.sqrt(along**2 - to_ball @ to_ball + 0.2**2)
    assert depth[20, 32] == pytest.approx(distance * ray[2], abs=1e-9)


def test_transforms_look_at_the_focus(capture: Path) -> None:
    transforms = json.loads((capture / "transforms.json").read_text())
    focus = make_room(0).focus
    for frame in transforms["frames"]:
        camera_to_world = np.array(frame["transform_matrix"])
        assert (capture / frame["file_path"]).is_file()
        local = camera_to_world[:3, :3].T @ (focus - camera_to_world[:3, 3])
        # OpenGL axes: ahead is -z; the tremor moves the aim by well under two degrees.
        assert local[2] < 0 and np.hypot(local[0], local[1]) < 0.035 * -local[2]


def test_truth_table_says_what_was_done(capture: Path) -> None:
    table = pq.read_table(capture / "truth" / "frames.parquet").to_pylist()
    assert [row["frame_id"] for row in table] == list(range(8))
    for row in table:
        sharp = sharpness(capture / "truth" / "observed" / row["image"])
        ratio = sharpness(capture / row["image"]) / sharp
        # At 96 px wide, 7 px of the 640 px reference are 1 px: enough to lose most of the finest detail.
        if row["blur_px"] > 1.0 or row["defocus_px"] > 0:
            assert ratio < 0.75
        elif row["exposure_ev"] == 0:
            assert ratio > 0.75


def test_sweep_is_centred_on_the_pose_and_as_long_as_asked() -> None:
    middle = make_path(np.array([0.0, 1.0, -1.0]), 16, 0).pose(1.0)
    instants = np.linspace(-0.5, 0.5, 11)
    poses = exposure_poses(middle, instants, 0.05, np.random.default_rng(0))
    np.testing.assert_allclose(poses[5], middle, atol=1e-12)
    turn = np.arccos((np.trace(poses[0, :, :3].T @ poses[-1, :, :3]) - 1) / 2)
    # The roll, a random share of the sweep, adds to the aim's turn; the bend does not change the chord.
    assert 0.05 <= turn < 0.06


@pytest.mark.parametrize("protocol", sorted(PROTOCOLS))
def test_protocols_draw_what_their_name_says(protocol: str) -> None:
    faults = degradations(protocol, 400, 3)
    blur = np.mean([fault.blur for fault in faults])
    expected = {"gs2e-slight": 6, "gs2e-medium": 12, "gs2e-severe": 20, "sharp": 0}
    if protocol in expected:
        # A gamma of shape 4 deviates by half its mean: 400 draws fix the mean to 2.5 %; four deviations.
        assert blur == pytest.approx(expected[protocol], rel=0.1)
    else:
        spoilt = [fault.blur > 1 or fault.defocus > 0 or fault.exposure != 0 for fault in faults]
        assert np.mean(spoilt) == pytest.approx(0.5, abs=0.01)


def test_refuses_an_unknown_protocol_and_a_used_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        make(tmp_path / "x", protocol="gs2e-mild")
    assert "gs2e-slight" in error.value.hint
    (tmp_path / "x").mkdir(exist_ok=True)
    (tmp_path / "x" / "mine.txt").write_text("keep")
    with pytest.raises(InputError):
        make(tmp_path / "x")
    assert (tmp_path / "x" / "mine.txt").read_text() == "keep"
