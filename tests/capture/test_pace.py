"""Frames of a video by motion: pauses take few frames, and an even walk keeps its frames."""

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
from cleargs.types import ArrayF64

from .conftest import texture

WIDTH, HEIGHT = 192, 108


def filmed(path: Path, places: ArrayF64, tremor: float = 0.0, pointer: bool = False) -> Path:  # places [F] px
    """Write a video of 30 frames per second that moves over a texture to ``places``; 800 px at most."""
    wide = cv2.resize(np.hstack([texture(0), texture(1)]), (1100, 400))
    random = np.random.default_rng(0)
    shakes = cv2.GaussianBlur(random.normal(0, 3 * tremor, (len(places), 2)), (1, 9), 2)
    pictures = []
    for number, (place, shake) in enumerate(zip(places, shakes, strict=True)):
        move = np.array([[1, 0, 10 + place + shake[0]], [0, 1, 100 + shake[1]]])
        picture = cv2.warpAffine(wide, move, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        picture = np.clip(picture + random.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)
        if pointer:
            cv2.circle(picture, (20 + 7 * number % 150, 50), 6, (255, 255, 255), -1)
        pictures.append(picture)
    write_video(path, pictures, 30.0)
    return path


def chosen(video: Path, at_most: int) -> list[int]:
    capture = open_capture(video, IngestConfig(max_frames=at_most))
    found = select_sharp_frames(capture, 128, SilentReporter())
    return [int(frame.name.rpartition("_")[2]) for frame in found.frames]


def views(places: ArrayF64, numbers: list[int], apart: float) -> int:
    """Return the number of the chosen views that are at least ``apart`` px from the one before."""
    last, count = -np.inf, 0
    for place in places[numbers]:
        if place - last >= apart:
            last, count = place, count + 1
    return count


def pauses(moving: int, still: int, parts: int, step: float) -> ArrayF64:
    """Return places of a walk of ``moving`` frames with ``parts`` pauses of together ``still`` frames."""
    steps = [np.r_[np.zeros(still // parts), np.full(moving // parts, step)] for _ in range(parts)]
    return np.cumsum(np.concatenate(steps))


@pytest.mark.parametrize("parts", [1, 3, 6])
@pytest.mark.parametrize(("tremor", "pointer"), [(0.0, True), (1.0, False)])
def test_pauses_take_few_frames(tmp_path: Path, parts: int, tremor: float, pointer: bool) -> None:
    """By the clock 12 of 40 frames show different views."""
    places = pauses(72, 180, parts, 8.0)
    numbers = chosen(filmed(tmp_path / "walk.mp4", places, tremor, pointer), 40)
    assert len(numbers) <= 40
    assert views(places, numbers, 6.0) >= 34


def test_a_long_pause_at_both_ends_takes_a_few_frames(tmp_path: Path) -> None:
    places = np.r_[np.zeros(240), np.cumsum(np.full(60, 10.0)), np.full(240, 600.0)]
    numbers = chosen(filmed(tmp_path / "walk.mp4", places, 1.0), 30)
    assert sum(number < 235 or number > 305 for number in numbers) <= 4 and len(numbers) >= 26


def test_slow_and_fast_parts_get_views_alike(tmp_path: Path) -> None:
    places = np.cumsum(np.r_[np.full(120, 1.0), np.full(120, 5.0)])
    numbers = chosen(filmed(tmp_path / "walk.mp4", places), 24)
    steps = np.diff(places[numbers])
    assert len(numbers) == 24 and steps.max() < 2.2 * steps.mean()


@pytest.mark.parametrize("tremor", [0.0, 1.0])
def test_an_even_walk_keeps_its_frames(tmp_path: Path, tremor: float) -> None:
    video = filmed(tmp_path / "walk.mp4", np.cumsum(np.full(200, 4.0)), tremor)
    capture = open_capture(video, IngestConfig(max_frames=25))
    both = [select_sharp_frames(capture, 128, SilentReporter(), by_motion=way) for way in (True, False)]
    assert both[0] == both[1]
