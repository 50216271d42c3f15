"""The sharpest frame of each stretch of a video is taken."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cleargs.capture.choice import select_sharp_frames
from cleargs.capture.sources import open_capture
from cleargs.media.encode import write_video
from cleargs.progress import SilentReporter
from cleargs.stages.ingest import IngestConfig

from .conftest import texture

# Four of 12 frames are chosen evenly (0, 4, 7, 11), which splits the others into 0-2, 3-5, 6-9 and 10-11.
SHARP = [1, 3, 9, 10]


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """A pan over a texture; every frame but `SHARP` is blurred."""
    picture = texture(0)
    frames = [picture[100:196, 8 * number : 8 * number + 128] for number in range(12)]
    blurred = [cv2.blur(frame, (9, 1)) for frame in frames]
    shown = [frames[number] if number in SHARP else blurred[number] for number in range(12)]
    write_video(tmp_path / "walk.mp4", shown, 10.0)
    return tmp_path / "walk.mp4"


def test_sharp_frames_of_a_video_are_taken(video: Path) -> None:
    capture = open_capture(video, IngestConfig(max_frames=4))
    chosen = select_sharp_frames(capture, 64, SilentReporter())
    assert [frame.name for frame in chosen.frames] == [f"walk_{number:06d}" for number in SHARP]
    assert np.allclose([frame.time_s for frame in chosen.frames], np.array(SHARP) / 10)


def test_a_video_that_is_taken_whole_stays_as_it_is(video: Path) -> None:
    capture = open_capture(video, IngestConfig())
    assert select_sharp_frames(capture, 64, SilentReporter()) == capture
