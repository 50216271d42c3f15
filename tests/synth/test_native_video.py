"""The whole video of a walk: its frames, and the true motion of the camera in each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.linalg import expm

from benchmarks.native import write_native
from cleargs.capture.folders import spread
from cleargs.cli.main import invoke
from cleargs.errors import InputError
from cleargs.media.image import read_rgb
from cleargs.media.video import decode_frames, read_timeline
from cleargs.progress import SilentReporter
from cleargs.synth import synthetic_capture
from cleargs.synth.image_motion import SimulatedMotion, track_motion
from cleargs.synth.native_video import NATIVE_FPS, STRIDE, native_frames, true_motion
from cleargs.synth.optics import instant_shutter
from cleargs.synth.path import HandheldPath, frame_times
from cleargs.synth.phone import develop
from cleargs.synth.protocols import Fault
from cleargs.synth.raycast import room_setup
from cleargs.synth.synthetic_capture import make_capture

FRAMES, WIDTH, HEIGHT, SEED = 5, 96, 54, 3
BY_VIDEO = {"capture.mp4", "truth/motion.parquet", "truth/capture.json"}
"""Files that differ with and without the video."""


def make(folder: Path, protocol: str, *, seed: int = SEED, video: bool = True) -> Path:
    size = {"frames": FRAMES, "width": WIDTH, "height": HEIGHT}
    make_capture(folder, protocol, **size, seed=seed, reporter=SilentReporter(), video=video)
    return folder


def files(folder: Path) -> dict[str, bytes]:
    found = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def decoded(capture: Path) -> list[np.ndarray]:
    path = capture / "capture.mp4"
    return [frame.astype(np.float64) for _, frame in decode_frames(path, read_timeline(path).pts)]


def motion(capture: Path) -> list[dict[str, Any]]:
    return list(pq.read_table(capture / "truth" / "motion.parquet").to_pylist())


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a - b) ** 2)))


def matrices(rows: list[dict[str, Any]]) -> np.ndarray:
    """World to camera [F, 4, 4]."""
    last = np.broadcast_to([[[0.0, 0.0, 0.0, 1.0]]], (len(rows), 1, 4))
    return np.concatenate([np.reshape([row["world_to_camera"] for row in rows], (-1, 3, 4)), last], 1)


def generator(twist: np.ndarray) -> np.ndarray:  # [6]
    """The matrix [4, 4] with dW/dt = generator @ W."""
    (a, b, c), (x, y, z) = twist[:3], twist[3:]
    return np.array([[0, -z, y, a], [z, 0, -x, b], [-y, x, 0, c], [0, 0, 0, 0]])


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("native")
    return {name: make(folder / name, name) for name in ("sharp", "gsotm-mb-rs", "mixed", "camera", "phone")}


@pytest.mark.parametrize("name", ["sharp", "gsotm-mb-rs", "mixed", "camera", "phone"])
def test_every_fifth_frame_of_the_video_is_in_the_capture(captures: dict[str, Path], name: str) -> None:
    capture = captures[name]
    timeline = read_timeline(capture / "capture.mp4")
    rows, shown = motion(capture), decoded(capture)
    times = np.array([row["time_s"] for row in rows])
    assert len(rows) == len(shown) == STRIDE * FRAMES
    assert [row["video_frame"] for row in rows] == list(range(len(rows)))
    # The track of an MP4 has a resolution of 1/15360 s or better.
    seconds = [timeline.seconds(number) for number in range(len(rows))]
    assert seconds == pytest.approx(list(times - times[0]), abs=1e-4)
    truth = pq.read_table(capture / "truth" / "frames.parquet").to_pylist()
    chosen = [row for row in rows if row["image"] is not None]
    assert [row["video_frame"] for row in chosen] == [2, 7, 12, 17, 22]
    for row, exact in zip(chosen, truth, strict=True):
        assert row["image"] == exact["image"]
        for column in ("time_s", "exposure_s", "readout_s"):
            assert row[column] == pytest.approx(exact[column], abs=1e-12)
        image = read_rgb(capture / row["image"]).astype(np.float64)
        here = psnr(shown[row["video_frame"]], image)
        # 31.7 to 35.6 dB: chroma at half resolution on a tiny noisy image. For the phone, with two codecs,
        # 27.6 to 30.2 dB. The frames next to it are 2.4 to 12.7 dB worse.
        assert here > (26.5 if name == "phone" else 30)
        assert here > max(psnr(shown[row["video_frame"] + step], image) for step in (-1, 1)) + 1.5
        if name != "phone":  # colours do not shift
            assert np.abs((shown[row["video_frame"]] - image).mean((0, 1))).max() < 0.7


def test_a_room_with_all_frames_gives_the_frames_of_the_capture(
    captures: dict[str, Path], tmp_path: Path
) -> None:
    """An ingest of as many frames takes those whose sharp truth the room has."""
    write_native(captures["sharp"], tmp_path, chosen=False)
    names = sorted(path.name for path in (tmp_path / "images").iterdir())
    assert len(names) == STRIDE * (FRAMES - 1) + 1
    assert spread(names, FRAMES) == [f"{number:06d}.png" for number in (2, 7, 12, 17, 22)]


def test_a_video_changes_no_other_file(captures: dict[str, Path], tmp_path: Path) -> None:
    for name in ("mixed", "phone"):
        plain, filmed = files(make(tmp_path / name, name, video=False)), files(captures[name])
        assert set(filmed) - set(plain) <= BY_VIDEO
        same = set(plain) - BY_VIDEO
        assert {key: plain[key] for key in same} == {key: filmed[key] for key in same}
        summary, other = (json.loads(found["truth/capture.json"]) for found in (filmed, plain))
        assert summary.pop("video_fps") == NATIVE_FPS and other.pop("video_fps") in (None, 6.0)
        assert summary == other


def test_only_equal_seeds_give_equal_videos(captures: dict[str, Path], tmp_path: Path) -> None:
    for name in ("sharp", "phone"):
        first, again = files(captures[name]), files(make(tmp_path / name, name))
        assert first == again
    first, other = files(captures["sharp"]), files(make(tmp_path / "other", "sharp", seed=SEED + 1))
    assert all(other[name] != first[name] for name in ("capture.mp4", "truth/motion.parquet"))


def test_poses_and_twists_are_those_of_the_path(captures: dict[str, Path]) -> None:
    rows = motion(captures["phone"])
    given = json.loads((captures["phone"] / "truth" / "observed" / "transforms.json").read_text())["frames"]
    exact = [frame["transform_matrix"] @ np.diag([1.0, -1.0, -1.0, 1.0]) for frame in given]
    to_camera = matrices(rows)
    np.testing.assert_allclose(to_camera[STRIDE // 2 :: STRIDE], np.linalg.inv(exact), atol=1e-9)
    setup = room_setup(FRAMES, WIDTH, HEIGHT, SEED)
    path, step = HandheldPath(setup.course, FRAMES, SEED, stretched=True), 1e-3

    def pose(time: float) -> np.ndarray:
        return np.linalg.inv(np.vstack([path.poses(np.array([time]))[0], [0, 0, 0, 1]]))

    fastest = max(np.abs(row["twist"]).max() for row in rows)
    steepest = max(np.abs(row["twist_rate"]).max() for row in rows)
    assert fastest > 0.3 and steepest > 3
    for row, here in zip(rows, to_camera, strict=True):
        twist, rate = np.array(row["twist"]), np.array(row["twist_rate"])
        change = (pose(row["time_s"] + step) - pose(row["time_s"] - step)) / (2 * step) @ np.linalg.inv(here)
        # The error of the difference is (2 pi 12 Hz step)^2 / 6, a thousandth.
        np.testing.assert_allclose(change, generator(twist), atol=2e-3 * fastest)
        # The twist and its rate predict the pose: the rest is of third order in the step.
        for sign in (-1, 1):
            moved = expm(generator(sign * step * twist + step**2 / 2 * rate)) @ here
            straight = expm(generator(sign * step * twist)) @ here
            rest = np.abs(moved - pose(row["time_s"] + sign * step)).max()
            assert rest < 100 * steepest * step**3
            if np.abs(rate).max() > 0.2 * steepest:
                assert rest < 0.2 * np.abs(straight - pose(row["time_s"] + sign * step)).max()


def test_frames_that_stand_still_have_no_exposure_or_readout(captures: dict[str, Path]) -> None:
    assert all((row["exposure_s"], row["readout_s"]) == (0.0, 0.0) for row in motion(captures["sharp"]))
    both = motion(captures["gsotm-mb-rs"])
    assert len({(row["exposure_s"], row["readout_s"]) for row in both}) == 1
    assert both[0]["exposure_s"] > 0 and both[0]["readout_s"] > 0


def test_a_frame_in_between_has_the_faults_of_its_time() -> None:
    setup = room_setup(3, WIDTH, HEIGHT, SEED)
    path = HandheldPath(setup.course, 3, SEED)
    motions: list[SimulatedMotion] = []
    for time, pose in zip(frame_times(3), path.poses(frame_times(3)), strict=True):
        motions.append(track_motion(path, float(time), setup.world.depth(pose, setup.lens), setup.lens))
    faults = [Fault(0.01, 0.0, stops=0.0), Fault(0.02, 0.0, 3.0, stops=1.0), Fault(0.01, 0.0, stops=0.5)]
    frames = native_frames(motions, faults)
    assert [round(fault.stops, 9) for _, fault in frames] == [
        *(0.0, 0.0, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.5, 0.5)
    ]
    assert [fault.exposure for _, fault in frames] == [0.01] * 5 + [0.02] * 5 + [0.01] * 5
    assert [fault.defocus for _, fault in frames] == [0.0] * 5 + [3.0] * 5 + [0.0] * 5
    times = [row["time_s"] for row in true_motion(frames, ["a", "b", "c"]).to_pylist()]
    assert times == pytest.approx(list((np.arange(15) + 0.5) / 30))


def test_noise_of_every_frame_is_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before_codec: list[np.ndarray] = []
    monkeypatch.setattr(
        synthetic_capture, "write_video", lambda path, frames, *_, **__: before_codec.extend(frames)
    )
    setup = room_setup(FRAMES, WIDTH, HEIGHT, SEED)
    poses = np.linalg.inv(matrices(motion(make(tmp_path / "a", "sharp"))))[:, :3]
    clean = [develop(setup.world.render(instant_shutter(pose, HEIGHT), setup.lens)) for pose in poses]
    noise = np.array(before_codec, np.float64) - clean
    assert 0.5 < noise.std() < 2  # `NOISE` is 1 level at mid grey
    alike = np.corrcoef(noise.reshape(len(noise), -1)) - np.eye(len(noise))
    # Four standard deviations of the correlation of 15,552 independent values.
    assert np.abs(alike).max() < 4 / np.sqrt(noise[0].size)


def test_photographs_have_no_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="one photograph per second") as error:
        make(tmp_path / "a", "tremor")
    assert "--video" not in error.value.hint and not (tmp_path / "a").exists()
    assert invoke(["synth", str(tmp_path / "a"), "--protocol", "tremor", "--video"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2
