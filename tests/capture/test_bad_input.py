"""Inputs that cannot be used: an error of one line with a remedy, and nothing that passes for done."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cleargs.capture.sources import open_capture
from cleargs.capture.tables import load_points
from cleargs.errors import CleargsError, ConfigError, InputError, StageError
from cleargs.media.image import read_rgb
from cleargs.pipeline.config import load_config
from cleargs.pipeline.stages import installed
from cleargs.stages.ingest import IngestConfig

from . import apps
from .conftest import HEIGHT, WIDTH, Ingest, camera_to_world, write_transforms

Frames: TypeAlias = Sequence[tuple[NDArray[np.float64], NDArray[np.uint8]]]


def refused(caught: pytest.ExceptionInfo[CleargsError]) -> bool:
    """One line of cause, one of remedy."""
    return "\n" not in str(caught.value) and bool(caught.value.hint) and "\n" not in caught.value.hint


def edit_transforms(folder: Path, change: Any) -> None:
    path = folder / "transforms.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda d: d["frames"][3]["transform_matrix"][0].__setitem__(3, float("nan")),
            "pose of images/003.png",
        ),
        (
            lambda d: d["frames"][3]["transform_matrix"][0].__setitem__(3, 1e308),
            "pose of images/003.png is not finite, or out of reach",
        ),
        (lambda d: d["frames"][3].pop("transform_matrix"), "images/003.png has no pose"),
        (lambda d: d["frames"][3].__setitem__("transform_matrix", [[1, 2], [3, 4]]), "4x4"),
        (lambda d: d["frames"][3].__setitem__("transform_matrix", "none"), "matrix of numbers"),
        (lambda d: d["frames"][3].__setitem__("transform_matrix", np.zeros((4, 4)).tolist()), "rotation"),
        (lambda d: d.pop("frames"), "it has no 'frames'"),
        (lambda d: d["frames"][3].pop("file_path"), r"frames\[3\] has no file_path"),
        (lambda d: d.__setitem__("frames", 7), "frames"),
        (lambda d: d.__setitem__("fl_x", "long"), "camera"),
        (lambda d: d.__setitem__("fl_x", -5), "focal length"),
        (lambda d: d.__setitem__("k1", float("inf")), "not finite"),
        (lambda d: d.__setitem__("fl_x", 1e300), "that no lens has"),
        (lambda d: d.__setitem__("fl_x", 1e-300), "focal length"),
        (lambda d: d.__setitem__("camera_model", "EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
        (lambda d: d.__setitem__("w", 999), "proportions"),
        (lambda d: d.__setitem__("frames", d["frames"][:2]), "at least 3"),
    ],
)
def test_bad_transforms(posed: Path, ingest: Ingest, change: Any, words: str) -> None:
    edit_transforms(posed, change)
    with pytest.raises(InputError, match=words) as caught:
        ingest(posed)
    assert refused(caught)


def test_damaged_json(posed: Path, ingest: Ingest) -> None:
    (posed / "transforms.json").write_text('{"frames": [')
    with pytest.raises(InputError, match="cannot read"):
        ingest(posed)


def test_cameras_that_do_not_move(posed: Path, ingest: Ingest) -> None:
    poses = camera_to_world(10)
    for pose in poses:
        pose[:3, 3] = 1.0
    write_transforms(posed, poses)
    with pytest.raises(InputError, match="same place"):
        ingest(posed)


def test_zero_byte_and_broken_images(images: Path, ingest: Ingest) -> None:
    (images / "view4.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"view4\.png is empty") as caught:
        ingest(images, "one")
    assert refused(caught)
    (images / "view4.png").write_bytes(b"not a picture at all")
    with pytest.raises(InputError, match=r"view4\.png is not an image"):
        ingest(images, "two")


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_images(images: Path, count: int) -> None:
    for path in sorted(images.iterdir())[count:]:
        path.unlink()
    with pytest.raises(InputError, match="no images" if count == 0 else "at least 3") as caught:
        open_capture(images, IngestConfig())
    assert refused(caught)


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        open_capture(tmp_path / "nowhere", IngestConfig())


def test_damaged_colmap_model(first: Path) -> None:
    project = first
    sparse = project / "colmap" / "sparse" / "0"
    whole = {path: path.read_bytes() for path in sparse.iterdir()}
    for path, data in whole.items():
        path.write_bytes(data[: len(data) // 2])
        with pytest.raises(InputError, match="cannot read the COLMAP model") as caught:
            open_capture(project, IngestConfig())
        assert refused(caught)
        path.write_bytes(data)
    for offset, number in (
        (12, float("nan")),
        (44, 1e300),
    ):  # offsets in the first quaternion and translation
        images = bytearray(whole[sparse / "images.bin"])
        struct.pack_into("<d", images, offset, number)
        (sparse / "images.bin").write_bytes(images)
        with pytest.raises(InputError, match="not finite"):
            open_capture(project, IngestConfig())
    (sparse / "images.bin").write_bytes(whole[sparse / "images.bin"])
    assert open_capture(project, IngestConfig(poses="sfm")).kind == "images"


def test_inputs_stay_as_they_are(posed: Path, ingest: Ingest) -> None:
    before = {
        path: (path.stat().st_mtime_ns, path.read_bytes()) for path in posed.rglob("*") if path.is_file()
    }
    ingest(posed)
    after = {
        path: (path.stat().st_mtime_ns, path.read_bytes()) for path in posed.rglob("*") if path.is_file()
    }
    assert before == after


@pytest.mark.parametrize("shade", [0, 128])
def test_textureless_frames(posed: Path, images: Path, ingest: Ingest, shade: int) -> None:
    for folder in (posed / "images", images):
        for path in folder.iterdir():
            cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), shade, np.uint8))
    for number, source in enumerate((posed, images)):
        with pytest.raises(StageError, match="no features were found") as caught:
            ingest(source, f"out{number}")
        assert refused(caught)


def test_frames_that_are_all_the_same(posed: Path, images: Path, ingest: Ingest) -> None:
    """A camera that stood still, or a video that froze: with poses and without."""
    for folder in (posed / "images", images):
        first, *others = sorted(folder.iterdir())
        for path in others:
            path.write_bytes(first.read_bytes())
    for number, source in enumerate((posed, images)):
        with pytest.raises(StageError, match="10 frames show the same picture") as caught:
            ingest(source, f"out{number}")
        assert refused(caught)


def test_png_that_breaks_off_is_told_once(images: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = images / "view3.png"
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(InputError, match="not an image that can be read"):
        read_rgb(path)
    assert capfd.readouterr().err == "", "libpng has its own complaint"


def test_empty_colmap_files(posed: Path, ingest: Ingest) -> None:
    (posed / "transforms.json").unlink()
    model = posed / "sparse" / "0"
    model.mkdir(parents=True)
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.bin").write_bytes(b"")
    with pytest.raises(InputError, match="a file breaks off"):
        ingest(posed)


def test_holdout_says_what_it_takes() -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(installed(), overrides=["ingest.holdout=evry:3"])
    assert "every:N" in caught.value.hint


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.__setitem__("w", float("inf")), "too large"),
        (lambda d: d.__setitem__("w", 1e308), "more than"),
        (lambda d: d.__setitem__("cx", 10**400), "too large"),
        (lambda d: d.__setitem__("fl_x", 0), "focal length of 0"),
        (lambda d: [d.pop("fl_x"), d.pop("fl_y"), d.__setitem__("camera_angle_x", 0)], "camera of"),
        (lambda d: d["frames"][3].__setitem__("mask_path", "a\0b"), "does not exist"),
        (lambda d: d["frames"][3].__setitem__("mask_path", 7), "mask_path"),
    ],
)
def test_numbers_and_names_that_are_none(posed: Path, change: Any, words: str) -> None:
    edit_transforms(posed, change)
    with pytest.raises(InputError, match=words) as caught:
        open_capture(posed, IngestConfig())
    assert refused(caught)


def test_json_that_is_nested_too_deeply(posed: Path) -> None:
    (posed / "transforms.json").write_text('{"frames": ' + "[" * 200_000)
    with pytest.raises(InputError, match="nested too deeply") as caught:
        open_capture(posed, IngestConfig())
    assert refused(caught)


def test_points_that_are_not_finite_are_left_out(first: Path, ingest: Ingest) -> None:
    model = first / "colmap" / "sparse" / "0"
    points = bytearray((model / "points3D.bin").read_bytes())
    for value in (float("nan"), 1e300):  # for x of the first point, then y
        struct.pack_into("<d", points, 16, value)
        (model / "points3D.bin").write_bytes(points)
        again = ingest(first, f"again {value}")
        assert any("1 points of the input's sparse model" in line for line in again.warnings)
        table = load_points(again.out)
        assert len(table.xyz) and np.isfinite(table.xyz).all() and np.abs(table.xyz).max() < 1e9
    at, count = 8, struct.unpack_from("<Q", points)[0]
    for _ in range(count):  # id, x, y, z, colour, error, length of the track, track
        struct.pack_into("<d", points, at + 8, float("nan"))
        at += 51 + 8 * struct.unpack_from("<Q", points, at + 43)[0]
    (model / "points3D.bin").write_bytes(points)
    again = ingest(first, "none")
    assert any(f"{count} points of the input's sparse model" in line for line in again.warnings)
    assert len(load_points(again.out).xyz)


def test_a_mask_of_one_pixel(posed: Path, ingest: Ingest) -> None:
    (posed / "masks").mkdir()
    cv2.imwrite(str(posed / "masks" / "003.png"), np.full((1, 1), 255, np.uint8))
    with pytest.raises(InputError, match=r"the mask of images/003\.png is far smaller than it"):
        ingest(posed)


# -- files other than captures ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "beside", "kind", "remedy"),
    [
        ("IMG_1.xmp", "IMG_1.jpg", "a file of a photo editor", "give its folder"),
        ("IMG_1.AAE", "IMG_1.HEIC", "a list of edits of an iPhone photograph", "give its folder"),
        ("GX010123.THM", "GX010123.MP4", "the preview of a video", "GX010123.MP4, the video"),
        ("GL010123.LRV", "GX010123.MP4", "the small copy of a video", "GX010123.MP4, the video"),
        ("DJI_0001.SRT", "DJI_0001.MP4", "a file of subtitles or of a flight", "DJI_0001.MP4, the video"),
        ("info.json", "frame_0.jpg", "a file of data", "which has pictures"),
        ("info.json", None, "a file of data", "give a video, or a folder of images"),
        ("IMG_1.DNG", None, "a raw or other picture", "convert it to JPEG or PNG"),
        ("room.zip", None, "an archive", "unpack it"),
        ("scene.ply", None, "a 3D scene or model", "cleargs export, render and eval"),
        ("room.psx", None, "a project or an export of another program", "give a video, or a folder"),
        ("room.vrs", None, "a recording of a camera", "export its pictures"),
    ],
)
def test_a_file_of_another_kind_is_named(
    tmp_path: Path, name: str, beside: str | None, kind: str, remedy: str
) -> None:
    cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((24, 32, 3), np.uint8))
    (tmp_path / "a.jpg").rename(tmp_path / name)  # FFmpeg reads it, as it reads real previews
    if beside is not None:
        (tmp_path / beside).write_bytes(b"-")
    with pytest.raises(InputError, match=f"{name} is {kind}") as caught:
        open_capture(tmp_path / name, IngestConfig())
    assert refused(caught) and remedy in str(caught.value.hint)


def test_a_small_copy_of_a_video_is_refused_only_next_to_it(tmp_path: Path, frames: Frames) -> None:
    apps.clip(tmp_path / "rgb.mp4", [image for _, image in frames])
    copy = (tmp_path / "rgb.mp4").rename(tmp_path / "GL010123.LRV")
    assert len(open_capture(copy, IngestConfig()).frames) > 2
    shutil.copy(copy, tmp_path / "GX010123.MP4")
    with pytest.raises(InputError, match="the small copy of a video") as caught:
        open_capture(copy, IngestConfig())
    assert "GX010123.MP4, the video" in str(caught.value.hint)


def test_a_folder_without_pictures_names_what_it_has(tmp_path: Path) -> None:
    (tmp_path / "room.zip").write_bytes(b"PK")
    with pytest.raises(InputError, match="holds no images") as caught:
        open_capture(tmp_path, IngestConfig())
    assert caught.value.hint == "room.zip is an archive: unpack it, and give its folder"
