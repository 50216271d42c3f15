"""Two pictures of each view, one as filmed and one sharp, as in data sets for deblurring: one is taken."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from cleargs.capture.sources import externals, open_capture
from cleargs.stages.ingest import IngestConfig

from .apps import clip, save


def write(root: Path, *places: str, count: int = 6) -> Path:
    """Write a picture of 32 x 24 px for each of ``places`` ('blur/{}') and number."""
    for index in range(count):
        for number, place in enumerate(places):
            picture = np.random.default_rng(10 * index + number).integers(0, 255, (24, 32, 3))
            save(root / f"{place.format(f'{index:03d}')}.png", picture.astype(np.uint8))
    return root


@pytest.mark.parametrize(
    ("filmed", "true"),
    [
        ("blur/{}", "sharp/{}"),
        ("input/{}", "gt/{}"),
        ("Blurred/{}", "Sharp_images/{}"),
        ("ball/blur/{}", "ball/sharp/{}"),
        ("images/blur/{}", "images/sharp/{}"),
        ("blur/cam0/{}", "sharp/cam0/{}"),
        ("blur/blur_{}", "gt/gt_{}"),
        ("hazy/{}_hazy", "clean/{}_clean"),
        ("{}_blur", "{}_sharp"),
        ("{}", "{}_gt"),
        ("photos/{}", "photos_blur/{}"),
        ("noisy/{}", "ground_truth/{}"),
        ("degraded/{}", "target/{}"),
    ],
)
def test_one_picture_of_each_view_is_taken(tmp_path: Path, filmed: str, true: str) -> None:
    root = write(tmp_path / "set", filmed, true)
    capture = open_capture(root, IngestConfig())
    expected = {root / f"{filmed.format(f'{index:03d}')}.png" for index in range(6)}
    assert {frame.path for frame in capture.frames} == expected
    assert "left out: 6 second pictures of the same views" in capture.told
    assert any("--only" in note and "same views" in note for note in capture.notes)
    digested = externals(root, IngestConfig())
    assert not any(
        root / f"{true.format('000')}.png" in place.values()
        for place in digested.values()
        if isinstance(place, dict)
    )


@pytest.mark.parametrize(("filmed", "true"), [("input", "gt"), ("noisy", "clean")])
def test_poses_are_those_of_the_pictures_as_filmed(posed: Path, filmed: str, true: str) -> None:
    shutil.copytree(posed / "images", posed / true)
    (posed / "images").rename(posed / filmed)
    capture = open_capture(posed, IngestConfig())
    assert {frame.path.parent.name for frame in capture.frames} == {filmed} and len(capture.frames) == 10


def test_a_choice_takes_the_other_pictures(tmp_path: Path) -> None:
    root = write(tmp_path / "set", "blur/{}", "sharp/{}")
    capture = open_capture(root, IngestConfig(only="sharp"))
    assert {frame.path.parent.name for frame in capture.frames} == {"sharp"} and len(capture.frames) == 6
    assert capture.notes == ()


def test_three_versions_of_each_view(tmp_path: Path) -> None:
    """GoPro's data set for deblurring."""
    root = write(tmp_path / "set", "blur/{}", "blur_gamma/{}", "sharp/{}")
    capture = open_capture(root, IngestConfig())
    assert {frame.path.parent.name for frame in capture.frames} == {"blur"}
    assert "12 second pictures of the same views (blur_gamma/ 6, sharp/ 6)" in capture.told


def test_a_picture_without_a_partner_is_left_out_with_its_folder(tmp_path: Path) -> None:
    root = write(tmp_path / "set", "blur/{}", "sharp/{}")
    (root / "blur/002.png").unlink()
    assert len(open_capture(root, IngestConfig()).frames) == 5


@pytest.mark.parametrize(
    "places",
    [
        ("cam0/{}", "cam1/{}"),
        ("left/{}", "right/{}"),
        ("low/{}", "high/{}"),  # two orbits
        ("sharp/1{}", "blur/2{}"),  # other views
        ("sharpe/{}", "gtx/{}"),
        ("targets_left/a{}", "targets_right/b{}"),
        ("{}_sharp", "blur_1{}"),
    ],
)
def test_pictures_of_other_views_are_taken(tmp_path: Path, places: tuple[str, ...]) -> None:
    assert len(open_capture(write(tmp_path / "set", *places), IngestConfig()).frames) == 12


def test_sharp_pictures_alone_are_photographs(tmp_path: Path) -> None:
    assert len(open_capture(write(tmp_path / "set", "sharp/{}"), IngestConfig()).frames) == 6
    assert len(open_capture(write(tmp_path / "gt", "{}_gt"), IngestConfig()).frames) == 6


def test_one_of_two_videos_of_the_same_views_is_taken(tmp_path: Path) -> None:
    pictures = [np.full((240, 320, 3), 9 * index, np.uint8) for index in range(5)]
    for name in ("walk_blur.mp4", "walk_sharp.mp4"):
        clip(tmp_path / name, pictures)
    capture = open_capture(tmp_path, IngestConfig())
    assert {frame.path.name for frame in capture.frames} == {"walk_blur.mp4"}
    assert any("--only" in note and "walk_sharp.mp4" in note for note in capture.notes)
