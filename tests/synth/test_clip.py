"""Videos of whole walks: their frame rate and length, and blur that is made from one view and its depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cleargs.cli.main import invoke
from cleargs.media.video import read_timeline
from cleargs.synth.clip import moved
from cleargs.synth.image_motion import solve_duration, track_motion
from cleargs.synth.optics import instant_shutter, phone_lens
from cleargs.synth.path import HandheldPath, frame_times
from cleargs.synth.raycast import room_setup


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


@pytest.mark.parametrize("readout", [0.0, 0.03])
def test_moved_pixels_come_close_to_the_exact_exposure(readout: float) -> None:
    setup = room_setup(16, 192, 108, 0)
    path, time = HandheldPath(setup.course, 16, 0), float(frame_times(16)[5])
    pose = path.poses(np.array([time]))[0]
    motion = track_motion(path, time, setup.world.depth(pose, setup.lens), setup.lens)
    shutter = motion.shutter(solve_duration(4.0, motion.blur), readout)
    exact = setup.world.render(shutter, setup.lens)
    sharp = setup.world.render(instant_shutter(pose, 108), setup.lens)
    blurred = moved(sharp, setup.world.depth(pose, phone_lens(48, 27)), pose, setup.lens, shutter)
    # Measured: 34.5 and 34.3 dB, and 29.0 and 28.6 dB without the motion. The rest are edges of objects.
    assert psnr(blurred, exact) > max(33.0, psnr(sharp, exact) + 4)


def test_a_video_shows_the_whole_walk_at_its_frame_rate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["synth", str(tmp_path / "a"), "--protocol", "phone", "--size", "64x36", "--frames", "3"]
    assert invoke([*command, "--seconds", "1.5", "--fps", "8"]) == 0
    timeline = read_timeline(tmp_path / "a" / "capture.mp4")
    assert len(timeline.pts) == 12 and timeline.seconds(11) == pytest.approx(11 / 8, abs=1e-3)
    assert len(list((tmp_path / "a" / "images").iterdir())) == 3
    capsys.readouterr()
    command[1:4] = [str(tmp_path / "b"), "--protocol", "tremor"]
    assert invoke([*command, "--fps", "30"]) == 2  # a hand that holds still needs a fifth of a second
    assert "exposures of 0." in capsys.readouterr().err
