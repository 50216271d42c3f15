"""The up direction: flights that look down, cameras held sideways, apps and drones that state it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cleargs.capture.cameras import Pose, normalise, pinhole
from cleargs.capture.model import ModelImage, SparseModel
from cleargs.capture.sfm import Reconstruction
from cleargs.capture.sfm_job import SfmOutcome
from cleargs.capture.upright import find_up, stated_up
from cleargs.progress import SilentReporter
from cleargs.types import ArrayF64

from .filmed import along_wall, flight, pan, walk

UP = np.array([0.0, 1.0, 0.0])


def model_of(poses: ArrayF64, back: float = 2.2) -> SparseModel:  # poses [F, 3, 4], camera to world
    """Return a model of a room with points near its floor, ``back`` metres behind the middle or less."""
    images = {
        number: ModelImage(
            f"{number}.png",
            1,
            Pose(pose[:, :3].T, -pose[:, :3].T @ pose[:, 3]),
            np.zeros((0, 2)),
            np.zeros(0, int),
        )
        for number, pose in enumerate(poses, 1)
    }
    points = np.random.default_rng(0).uniform([-2.5, 0.0, -2.2], [2.5, 0.4, back], (200, 3))
    return SparseModel(
        {1: pinhole(320, 240, 250, 250, 160, 120)}, images, np.arange(200), points, np.zeros(200)
    )


@pytest.mark.parametrize("strips", [1, 3, 4])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("tremble", [0.0, 5.0])
def test_a_flight_that_looks_down_has_up_against_its_view(strips: int, turned: bool, tremble: float) -> None:
    poses = flight(24, strips=strips, turned=turned)
    random = np.random.default_rng(strips)
    for pose in poses:
        pose[:, :3] = pose[:, :3] @ cv2.Rodrigues(np.radians(tremble) * random.uniform(-1, 1, 3))[0]
    up, told = find_up(model_of(poses), {})
    assert up is not None and up @ UP > np.cos(np.radians(3)) * np.linalg.norm(up)
    assert "straight down" in told and "--upright" in told


@pytest.mark.parametrize("poses", [walk(2, 24), walk(7, 40), pan(24, 100.0, radius=0.4)])
def test_ordinary_captures_take_the_tops_of_their_pictures(poses: ArrayF64) -> None:
    assert find_up(model_of(poses), {}) == (None, "")


@pytest.mark.parametrize("tilt", [40.0, 65.0])
@pytest.mark.parametrize("tremble", [0.0, 3.0])
def test_a_flight_that_looks_down_and_then_ahead_stands(tilt: float, tremble: float) -> None:
    """By the tops of the pictures up is 48 and 31 degrees off."""
    poses, random = flight(24, turned=True), np.random.default_rng(0)
    for number, pose in enumerate(poses):
        pitch = np.radians(tilt) * max(0, number - 11) / 12
        heading = cv2.Rodrigues(np.array([0, 0, np.radians(4.0 * number)]))[0]
        shake = cv2.Rodrigues(np.radians(tremble) * random.uniform(-1, 1, 3))[0]
        pose[:, :3] = pose[:, :3] @ heading @ cv2.Rodrigues(np.array([pitch, 0, 0]))[0] @ shake
    up, told = find_up(model_of(poses), {})
    assert up is not None and up @ UP > np.cos(np.radians(5)) * np.linalg.norm(up)
    assert "guess" in told


def test_a_guess_is_named() -> None:
    up, told = find_up(model_of(along_wall(24), -2.1), {})
    assert up is None and "guess" in told
    upright = walk(2, 30)
    sideways = np.stack([upright[:, :, 1], -upright[:, :, 0], upright[:, :, 2], upright[:, :, 3]], 2)
    up, told = find_up(model_of(sideways), {})
    assert up is None and "sideways" in told


def test_what_the_input_states_decides() -> None:
    upright = walk(2, 30)
    sideways = np.stack([upright[:, :, 1], -upright[:, :, 0], upright[:, :, 2], upright[:, :, 3]], 2)
    stated = {f"{number}.png": pose[:, :3].T @ UP for number, pose in enumerate(sideways, 1)}
    up, told = find_up(model_of(sideways), stated)
    assert up is not None and up @ UP > 0.999 * np.linalg.norm(up) and "states" in told


@pytest.mark.parametrize(
    ("pitch", "up"), [("-90.0", [0, 0, -1]), ("+0.0", [0, -1, 0]), ("-45", [0, -0.707, -0.707])]
)
def test_the_gimbal_of_a_drone_is_read(tmp_path: Path, pitch: str, up: list[float]) -> None:
    _, data = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))
    xmp = b'http://ns.adobe.com/xap/1.0/\0<rdf:Description drone-dji:GimbalRollDegree="+0.00" ' + (
        f'drone-dji:GimbalPitchDegree="{pitch}"/>'.encode()
    )
    marker = b"\xff\xe1" + (len(xmp) + 2).to_bytes(2, "big") + xmp
    (tmp_path / "a.jpg").write_bytes(data.tobytes()[:2] + marker + data.tobytes()[2:])
    found = stated_up(tmp_path / "a.jpg")
    assert found is not None and np.allclose(found, up, atol=1e-3)
    (tmp_path / "b.jpg").write_bytes(data.tobytes())
    assert stated_up(tmp_path / "b.jpg") is None and stated_up(tmp_path / "none.jpg") is None


def test_a_scene_stands_and_stays_so_when_it_is_adjusted() -> None:
    given = model_of(flight(24, turned=True))
    world = normalise([image.pose for image in given.images.values()])
    start = Reconstruction(given.moved(world), world, SfmOutcome(method="sfm"))
    stood = start.turned_up([], SilentReporter())
    adjusted, factor = stood.with_model(stood.model)
    for scene in (stood, adjusted):
        assert np.allclose(scene.similarity.rotation @ UP, [0, -1, 0], atol=1e-6)
        assert np.allclose(scene.model.xyz, scene.similarity.points(given.xyz), atol=1e-9)
    assert factor == pytest.approx(1.0)
