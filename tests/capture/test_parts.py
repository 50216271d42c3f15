"""The pure parts: cameras, models, pairs, hold-out, choosing frames, undistortion."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from OpenImageIO import ImageOutput, ImageSpec
from PIL import Image, ImageOps
from pydantic import ValidationError

from cleargs.capture.cameras import Intrinsics, Pose, Similarity, normalise, pinhole
from cleargs.capture.capture import SourceFrame
from cleargs.capture.choice import held_out, holdout_hash, sharpness
from cleargs.capture.database import apply_exif_focal
from cleargs.capture.folders import frame_key, masks_of, natural_key
from cleargs.capture.layouts.transforms import read_transforms
from cleargs.capture.layouts.video import _shares, choose_times
from cleargs.capture.matching import loop_pairs, sequential_pairs
from cleargs.capture.model import ModelImage, SparseModel, read_model, write_model
from cleargs.capture.prepare import WorkFrame, read_image, read_source_mask
from cleargs.capture.sfm import job_of
from cleargs.capture.sources import externals, open_capture
from cleargs.capture.undistort import MAX_TANGENT, undistorter
from cleargs.errors import InputError, StoreError
from cleargs.media.image import read_rgb
from cleargs.media.video import Timeline
from cleargs.parquet import column, read_table, write_table
from cleargs.sequences import spread
from cleargs.stages.ingest import IngestConfig

from .conftest import HEIGHT, WIDTH, texture

LENSES = [
    Intrinsics("SIMPLE_RADIAL", 320, 240, (300.0, 160.0, 120.0, -0.15)),
    Intrinsics("OPENCV", 320, 240, (300.0, 310.0, 155.0, 125.0, 0.12, -0.05, 0.002, -0.001)),
    Intrinsics("OPENCV_FISHEYE", 320, 240, (150.0, 150.0, 160.0, 120.0, 0.02, -0.01, 0.0, 0.0)),
]


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_undistorted_pixels_are_where_the_pinhole_says(lens: Intrinsics) -> None:
    # An image that says where it comes from: red is x, green is y of the lens's own pixels.
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    coded = np.stack([x * 0.75, y, np.full_like(x, 200)], axis=-1).astype(np.uint8)
    way = undistorter(lens, 960)
    flat = way.image(coded)
    size = way.pinhole.width, way.pinhole.height
    assert flat.shape[1::-1] == size
    # No empty pixel, not even in the corners.
    assert flat[..., 2].min() >= 199
    u, v = np.meshgrid(np.arange(8, size[0] - 8, 25) + 0.5, np.arange(8, size[1] - 8, 25) + 0.5)
    (fx, fy), (cx, cy) = way.pinhole.focal, way.pinhole.centre
    rays = np.stack([(u.ravel() - cx) / fx, (v.ravel() - cy) / fy, np.ones(u.size)], axis=1)
    there = lens.colmap().img_from_cam(rays)
    seen = flat[v.astype(int).ravel(), u.astype(int).ravel()].astype(float)
    # The codes are truncated to whole numbers: 1 code is 1.33 px in x and 1 px in y.
    assert np.abs(seen[:, 0] / 0.75 - there[:, 0]).max() < 2.5
    assert np.abs(seen[:, 1] - there[:, 1]).max() < 2
    assert np.allclose(way.points(there), np.stack([u.ravel(), v.ravel()], axis=1), atol=1e-3)


WIDE = [
    ("OPENCV_FISHEYE", 460, (460.0, 460.0, 500.0, 500.0, 0.0, 0.0, 0.0, 0.0)),  # corners at 88 degrees
    ("OPENCV_FISHEYE", 450, (450.0, 450.0, 500.0, 500.0, 0.0, 0.0, 0.0, 0.0)),  # corners at 90.03 degrees
    ("OPENCV_FISHEYE", 320, (320.0, 320.0, 500.0, 500.0, 0.0, 0.0, 0.0, 0.0)),  # sides at 89.5 degrees
    ("OPENCV_FISHEYE", 300, (300.0, 300.0, 500.0, 500.0, 0.01, -0.002, 0.0, 0.0)),
    ("RADIAL_FISHEYE", 250, (250.0, 500.0, 500.0, 0.02, 0.0)),  # nothing of the edge is in front
    ("THIN_PRISM_FISHEYE", 310, (310.0, 310.0, 500.0, 500.0, *[0.0] * 8)),
    ("SIMPLE_RADIAL_FISHEYE", 400, (400.0, 500.0, 500.0, 0.01)),
    ("FOV", 300, (300.0, 300.0, 500.0, 500.0, 1.0)),  # sides at 80, corners at 102 degrees
]


@pytest.mark.parametrize(("model", "focal", "params"), WIDE)
def test_a_fisheye_of_any_width_shows_60_degrees_to_each_side(
    model: str, focal: int, params: tuple[float, ...]
) -> None:
    way = undistorter(Intrinsics(model, 1000, 1000, params), 99999)
    assert way.pinhole.width == way.pinhole.height == int(2 * MAX_TANGENT * focal)


def test_points_at_90_degrees_and_behind_are_in_no_flat_image() -> None:
    way = undistorter(
        Intrinsics("OPENCV_FISHEYE", 1000, 1000, (320.0, 320.0, 500.0, 500.0, *[0.0] * 4)), 99999
    )
    to_the_side = np.array(
        [[30.0, 30.0], [999.0, 80.0], [500.0 + 320 * np.pi / 2 + 1e-6, 500.0], [0.0, 999.0]]
    )
    assert np.isnan(way.points(to_the_side)).all()
    assert not way.inside(way.points(to_the_side)).any()
    in_front = np.array([[500.0, 500.0], [200.0, 400.0], [500.0 + 320 * np.radians(60), 500.0]])
    assert way.inside(way.points(in_front)).all()


def test_a_pinhole_is_not_resampled() -> None:
    picture = texture(0)[:HEIGHT, :WIDTH]
    way = undistorter(pinhole(WIDTH, HEIGHT, 300, 300, 150, 130), 960)
    assert np.array_equal(way.image(picture), picture)
    half = undistorter(pinhole(WIDTH, HEIGHT, 300, 300, 150, 130), 160)
    assert half.pinhole == pinhole(160, 120, 150, 150, 75, 65)


def test_an_image_that_is_hardly_reduced_keeps_its_detail() -> None:
    # Barrel distortion: the flat image is 804 px wide, and is published with 800 px. Stripes of 4 px per
    # period would lose a third of their contrast where a second resampling averages two neighbours.
    lens = Intrinsics("SIMPLE_RADIAL", 800, 600, (800.0, 400.0, 300.0, -0.02))
    x = np.broadcast_to(np.arange(800) + 0.5, (600, 800))
    stripes = (127.5 + 100 * np.sin(0.5 * np.pi * x)).round().astype(np.uint8)
    flat = undistorter(lens, 800).image(np.stack([stripes] * 3, axis=-1))[..., 0].astype(float)
    assert flat.shape[1] == 800
    contrast = np.array([flat[:, start : start + 40].std() for start in range(0, 800, 40)])
    assert contrast.min() > 0.85 * 100 / np.sqrt(2)


@given(st.floats(0.1, 3), st.floats(-1, 1), st.integers(0, 2**31))
@settings(max_examples=30)
def test_normalised_world(scale: float, tilt: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    poses = []
    for centre in random.normal(size=(6, 3)) * scale + random.normal(size=3) * 10:
        rotation = cv2.Rodrigues(np.array([tilt, 0, 0]) + 0.2 * random.normal(size=3))[0]
        poses.append(Pose(rotation, -rotation @ centre))
    similarity = normalise(poses)
    moved = [similarity.pose(pose) for pose in poses]
    centres = np.stack([pose.centre for pose in moved])
    assert np.allclose(centres.mean(axis=0), 0, atol=1e-9)
    assert np.isclose(np.linalg.norm(centres, axis=1).max(), 1)
    up = -np.stack([pose.rotation[1] for pose in moved]).mean(axis=0)
    assert np.allclose(up / np.linalg.norm(up), [0, -1, 0], atol=1e-9)
    assert np.isclose(np.linalg.det(similarity.rotation), 1)
    points = random.normal(size=(5, 3))
    there = similarity.points(points)
    again = similarity.scale * there @ similarity.rotation + similarity.origin
    assert np.allclose(again, points, atol=1e-9)
    # Cameras see the same: x_camera is the same direction, nearer by the scale.
    before = points @ poses[0].rotation.T + poses[0].translation
    after = there @ moved[0].rotation.T + moved[0].translation
    assert np.allclose(after * similarity.scale, before, atol=1e-9)


@pytest.mark.parametrize("damage", ["gone", "[]", '{"scale": 2.0, "rotation": 3, "translation": [0, 0, 0]}'])
def test_a_run_without_its_world_names_the_remedy(tmp_path: Path, damage: str) -> None:
    world = Similarity(np.eye(3)[[1, 2, 0]], np.array([1e6 + 0.1, 2.0, 3.0]), 1 / 3)
    world.write(tmp_path)
    back = Similarity.read(tmp_path)
    assert np.array_equal(back.rotation, world.rotation) and np.array_equal(back.origin, world.origin)
    assert back.scale == world.scale
    (tmp_path / "world.json").unlink()
    if damage != "gone":
        (tmp_path / "world.json").write_text(damage)
    with pytest.raises(InputError, match="does not say how it was normalised"):
        Similarity.read(tmp_path)


def test_turning_about_the_half_turn() -> None:
    # Worlds with y up (OpenGL) need half a turn, whose axis must not hang on rounding errors.
    rotations = []
    for error in (1e-15, -1e-15):
        poses = [
            Pose(np.diag([1.0, -1.0, -1.0]) + error, np.array([float(index), 0.0, 0.0])) for index in range(3)
        ]
        rotations.append(normalise(poses).rotation)
    assert np.allclose(rotations[0], rotations[1], atol=1e-9)


def small_model() -> SparseModel:
    random = np.random.default_rng(1)
    ids = np.array([3, 5, 9, 12], np.int64)
    images = {
        key: ModelImage(
            f"a{key}.png",
            1,
            Pose.from_quaternion(np.array([1, 0.1, 0.2, 0.0]) / np.sqrt(1.05), random.normal(size=3)),
            random.random((3, 2)) * 100,
            ids[key : key + 3] if key else ids[:3],
        )
        for key in (0, 1)
    }
    images = {key + 1: image for key, image in images.items()}
    camera = {1: Intrinsics("OPENCV", 100, 80, (90.0, 91.0, 50.0, 40.0, 0.1, 0.0, 0.0, 0.0))}
    return SparseModel(camera, images, ids, random.normal(size=(4, 3)), random.random(4))


def test_models_agree_with_colmap(tmp_path: Path) -> None:
    model = small_model()
    rgb = np.arange(12, dtype=np.uint8).reshape(4, 3)
    write_model(tmp_path / "ours", model, rgb)
    theirs = pycolmap.Reconstruction(str(tmp_path / "ours"))
    assert theirs.num_reg_images() == 2 and theirs.num_points3D() == 4
    assert np.allclose(theirs.points3D[9].xyz, model.xyz[2]) and theirs.points3D[9].track.length() == 2
    for write, name in ((theirs.write_binary, "binary"), (theirs.write_text, "text")):
        (tmp_path / name).mkdir()
        write(str(tmp_path / name))
        back = read_model(tmp_path / name)
        assert back.cameras == model.cameras and np.array_equal(back.point_ids, model.point_ids)
        assert np.allclose(back.xyz, model.xyz) and np.allclose(back.error, model.error)
        for key, image in model.images.items():
            assert back.images[key].name == image.name
            assert np.allclose(back.images[key].xy, image.xy)
            assert np.array_equal(back.images[key].point_ids, image.point_ids)
            assert np.allclose(back.images[key].pose.rotation, image.pose.rotation)
            assert np.allclose(back.images[key].pose.translation, image.pose.translation)


@pytest.mark.parametrize(
    ("name", "offset"), [("points3D", 0), ("points3D", 51), ("images", 0), ("cameras", 0)]
)
def test_a_count_that_no_file_holds(tmp_path: Path, name: str, offset: int) -> None:
    """pycolmap alone would read on past the end of the file."""
    write_model(tmp_path, small_model(), np.zeros((4, 3), np.uint8))
    file = tmp_path / f"{name}.bin"
    data = bytearray(file.read_bytes())
    struct.pack_into("<Q", data, offset, 1 << 40)
    file.write_bytes(data)
    with pytest.raises(InputError, match="a file breaks off"):
        read_model(tmp_path)


@pytest.mark.parametrize("name", ["rigs", "frames"])
@pytest.mark.parametrize("damage", [b"", b"\xff\x07" * 700])
def test_damaged_rigs_are_not_read(tmp_path: Path, name: str, damage: bytes) -> None:
    """pycolmap would read on past the end of the file; so it runs in a separate process."""
    write_model(tmp_path, small_model(), np.zeros((4, 3), np.uint8))
    pycolmap.Reconstruction(str(tmp_path)).write_binary(tmp_path)
    (tmp_path / f"{name}.bin").write_bytes(damage)
    program = (
        "import sys; from pathlib import Path; from cleargs.capture.model import read_model\n"
        "print(len(read_model(Path(sys.argv[1])).images))"
    )
    command = [sys.executable, "-c", program, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    assert (done.returncode, done.stdout) == (0, "2\n"), done.stderr


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_resized_camera_scales_its_pixels(lens: Intrinsics) -> None:
    rays = np.array([[0.2, 0.1, 1.0], [-0.3, 0.2, 1.0]])
    before = lens.colmap().img_from_cam(rays)
    after = lens.resized(160, 120).colmap().img_from_cam(rays)
    assert np.allclose(after, before / 2)


def test_pairs() -> None:
    near = sequential_pairs(40, 3)
    assert {j for i, j in near if i == 0} == {1, 2, 3, 4} and max(j for _, j in near) == 39
    assert {j for i, j in sequential_pairs(200, 6) if i == 0} == {1, 2, 3, 4, 5, 6, 8, 16, 32}


def test_loops_join_what_looks_alike() -> None:
    random = np.random.default_rng(3)
    # Frames 0 and 10 share most descriptors, as do 1 and 11; all others are unrelated.
    descriptors = [random.integers(0, 255, (80, 128)).astype(np.uint8) for _ in range(12)]
    for first, second in ((0, 10), (1, 11)):
        descriptors[second][:60] = descriptors[first][:60]
    pairs = loop_pairs(descriptors, 1, 5, seed=0)
    assert {(0, 10), (1, 11)} <= set(pairs) and all(j - i >= 5 for i, j in pairs)
    assert loop_pairs([np.zeros((0, 128), np.uint8)] * 12, 1, 5, seed=0) == []


def test_holdout_rules() -> None:
    names = [f"clip/{index:02d}.png" for index in range(12)]
    everywhere = [True] * 12

    def read(index: int) -> np.ndarray:
        blur = 1 + 2 * (index % 4)
        return cv2.GaussianBlur(texture(0, 128), (blur, blur), 0)

    assert held_out("none", names, read, everywhere) == set()
    assert held_out("every:4", names, read, everywhere) == {0, 4, 8}
    assert held_out("sharpest:4", names, read, everywhere) == {0, 4, 8}
    # The last stretch may be shorter, and has a test frame too.
    assert held_out("sharpest:5", names, read, everywhere) == {0, 8, 10}
    assert held_out("sharpest:99", names, read, everywhere) == {0}
    assert held_out("03, clip/05.png,07.png", names, read, everywhere) == {3, 5, 7}
    assert held_out("0[13]*,clip/1*", names, read, everywhere) == {1, 3, 10, 11}
    # Frames without a pose cannot be test frames by sharpness, and count in no stretch.
    assert held_out("sharpest:4", names, read, [index != 0 for index in range(12)]) == {4, 8, 9}
    with pytest.raises(InputError, match="nowhere"):
        held_out("nowhere", names, read, everywhere)
    with pytest.raises(InputError, match="no frame to train"):
        held_out("every:2", names, read, [index == 0 for index in range(12)])


@pytest.mark.parametrize("height", [2, 63, 64, 65, 67, 130])
def test_sharpness_of_bands_is_that_of_the_whole_picture(height: int) -> None:
    grey = np.random.default_rng(height).integers(0, 256, (height, 50), dtype=np.uint8)
    binomial = np.array([1, 4, 6, 4, 1], np.float32)
    laplacian = cv2.Laplacian(cv2.sepFilter2D(grey, cv2.CV_32F, binomial, binomial), cv2.CV_32F)
    assert sharpness(grey) == pytest.approx(laplacian.astype(np.float64).var() / 256**2, rel=1e-12)


def test_sharpness_is_not_noise() -> None:
    picture = cv2.resize(texture(0, 256), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    blurred = [cv2.GaussianBlur(picture, (0, 0), sigma) for sigma in (1.0, 2.0, 4.0)]
    values = [sharpness(image) for image in (picture, *blurred)]
    assert values == sorted(values, reverse=True) and values[-1] > 0
    assert sharpness(np.full((40, 60, 3), 77, np.uint8)) == 0
    noise = np.random.default_rng(0).normal(0, 8, picture.shape)
    noisy = np.clip(np.rint(blurred[1] + noise), 0, 255).astype(np.uint8)
    assert cv2.Laplacian(noisy, cv2.CV_32F).var() > cv2.Laplacian(picture, cv2.CV_32F).var()
    assert sharpness(noisy) < values[0]


def test_hash_of_the_holdout() -> None:
    digest = holdout_hash("every:4", ["b", "a"])
    assert len(digest) == 64 and digest == holdout_hash("every:4", ["a", "b"])
    others = [
        holdout_hash(*split) for split in (("every:4", ["a"]), ("a,b", ["a", "b"]), ("every:4", ["ab"]))
    ]
    assert len({digest, *others}) == 4


@pytest.mark.parametrize(
    "rule", ["every:1", "sharpest:1", "every:x", "every:0", "fairest:3", "each:8", "", " , "]
)
def test_unknown_holdout_is_refused(rule: str) -> None:
    with pytest.raises(ValidationError):
        IngestConfig(holdout=rule)


def test_frames_are_chosen_in_time() -> None:
    # Ten frames in the first second, then one per second.
    pts = (*range(0, 100, 10), *range(100, 1001, 100))
    timeline = Timeline(pts, 0.01, None)
    assert choose_times(timeline, None, 150) == list(range(20))
    chosen = [timeline.seconds(index) for index in choose_times(timeline, None, 6)]
    assert chosen == [0, 2, 4, 6, 8, 10]
    assert [timeline.seconds(index) for index in choose_times(timeline, 0.5, 150)] == chosen
    assert len(choose_times(timeline, 1000, 150)) == 20
    assert [timeline.seconds(index) for index in choose_times(timeline, 1.0, 3)] == [0, 5, 10]
    assert choose_times(Timeline((7,), 0.01, None), 5.0, 150) == [0]


def test_videos_share_the_frames_by_their_length() -> None:
    short, long, single, empty = (Timeline(pts, 0.01, None) for pts in ((0, 100), (0, 100, 200), (7,), ()))
    assert _shares([long], 150) == [150]
    assert _shares([short, long, empty], 150) == [50, 100, 0]
    assert _shares([single, empty, single, single], 2) == [1, 0, 1, 0]


@given(st.integers(1, 300), st.integers(2, 50))
def test_spread_keeps_order_and_ends(count: int, at_most: int) -> None:
    chosen = spread(range(count), at_most)
    assert len(chosen) == min(count, at_most) and chosen[0] == 0 and chosen[-1] == count - 1
    gaps = np.diff(chosen)
    assert len(gaps) == 0 or (gaps.min() >= 1 and gaps.max() - gaps.min() <= 1)


def test_natural_order(images: Path) -> None:
    (images / "view10.png").write_bytes((images / "view0.png").read_bytes())
    (images / "notes.txt").write_text("not a picture")
    names = [frame.name for frame in open_capture(images, IngestConfig()).frames]
    assert names == [f"view{index}.png" for index in range(11)]
    assert sorted(["b2", "B10", "a"], key=natural_key) == ["a", "b2", "B10"]
    # The names by which 3dgs-deblur marks its split keep the order of the recording.
    split = ["images/train_frame_00001.png", "images/eval_frame_00002.png", "images/train_frame_00010.png"]
    assert sorted(split, key=frame_key) == split
    assert sorted(split) != split
    assert sorted(["eval_2.png", "retrain_1.png"], key=frame_key) == ["eval_2.png", "retrain_1.png"]


def test_exif_orientation(tmp_path: Path) -> None:
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[:20, :30] = 255  # bright at the top left, as stored
    ok, jpeg = cv2.imencode(".jpg", picture)
    assert ok
    # A minimal EXIF block: one entry, orientation 6 (turn clockwise for display).
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    body = b"Exif\0\0" + tiff
    path = tmp_path / "turned.jpg"
    data = jpeg.tobytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:])
    upright = read_rgb(path)
    assert upright.shape == (60, 40, 3)
    assert upright[10, 30].min() > 200 and upright[10, 10].max() < 50  # bright at the top right
    assert read_rgb(path, upright=False).shape == (40, 60, 3)


@pytest.mark.parametrize(
    ("extra", "model", "params"),
    [
        ({"fl_x": 300, "cx": 150, "cy": 110}, "PINHOLE", (300, 300, 150, 110)),
        ({"camera_angle_x": 2 * np.arctan(0.5)}, "PINHOLE", (320, 320, 160, 120)),
        ({"fl_x": 300, "fl_y": 310, "k1": 0.1, "p2": 0.01}, "OPENCV", (300, 310, 160, 120, 0.1, 0, 0, 0.01)),
        (
            {"fl_x": 300, "k1": 0.1, "k4": 0.2, "camera_model": "OPENCV_FISHEYE"},
            "OPENCV_FISHEYE",
            (300, 300, 160, 120, 0.1, 0, 0, 0.2),
        ),
        (
            {"fl_x": 300, "k1": 0.1, "k3": 0.3},
            "FULL_OPENCV",
            (300, 300, 160, 120, 0.1, 0, 0, 0, 0.3, 0, 0, 0),
        ),
    ],
)
def test_forms_of_transforms(images: Path, extra: dict, model: str, params: tuple[float, ...]) -> None:
    entry = {"file_path": "./view0", "transform_matrix": np.eye(4).tolist()}
    # The frame's own entries count before those of the file; extensions may be missing.
    data = {"w": 1, "h": 1, "frames": [entry | {"w": WIDTH, "h": HEIGHT}]} | extra
    path = images / "transforms.json"
    path.write_text(json.dumps(data))
    (frame,) = read_transforms(path, poses=True)
    assert frame.camera is not None and frame.pose is not None
    assert frame.camera.model == model and np.allclose(frame.camera.params, params)
    assert frame.path == images / "view0.png" and frame.name == "view0.png"
    # OpenGL looks along -z with y up: the identity turns y and z.
    assert np.allclose(frame.pose.rotation, np.diag([1, -1, -1]))


def test_names_with_dots_and_slashes_of_windows(images: Path) -> None:
    (images / "images").mkdir()
    for index in range(2):
        shutil.copy(images / "view0.png", images / "images" / f"frame.{index:04d}.png")
    entries = [
        {"file_path": path, "transform_matrix": np.eye(4).tolist()}
        for path in ("images/frame.0000", "images\\frame.0001")
    ]
    path = images / "transforms.json"
    path.write_text(json.dumps({"w": WIDTH, "h": HEIGHT, "fl_x": 50.0, "frames": entries}))
    found = [frame.name for frame in read_transforms(path, poses=True)]
    assert found == ["images/frame.0000.png", "images/frame.0001.png"]


def test_a_frame_name_may_be_a_number_or_a_time() -> None:
    assert IngestConfig.model_validate({"holdout": 7}).holdout == "7"
    assert IngestConfig(holdout="2024-05-01T12:30:01.jpg").holdout == "2024-05-01T12:30:01.jpg"


def pictures_of(folder: Path) -> dict[str, Path]:
    return {path.name: path for path in folder.glob("*.png")}


def test_an_empty_folder_of_images_hides_no_other(images: Path) -> None:
    (images / "images").mkdir()
    assert externals(images, IngestConfig()) == {"capture": pictures_of(images)}
    assert len(open_capture(images, IngestConfig()).frames) == len(list(images.glob("*.png")))


def test_masks_lie_as_their_images_do(tmp_path: Path) -> None:
    names = ["cam1/0001.jpg", "cam2/0001.jpg", "cam2/0002.jpg", "0003.jpg"]
    for mask in ("cam1/0001.jpg.png", "0001.png", "0002.png", "0003.png"):
        (tmp_path / mask).parent.mkdir(exist_ok=True)
        (tmp_path / mask).write_bytes(b"")
    found = {name: path.relative_to(tmp_path).as_posix() for name, path in masks_of(tmp_path, names).items()}
    # 0001.png could be of either camera, so it is of none.
    assert found == {
        "cam1/0001.jpg": "cam1/0001.jpg.png",
        "cam2/0002.jpg": "0002.png",
        "0003.jpg": "0003.png",
    }


def test_every_camera_has_the_exif_of_an_image_of_its_own(images: Path) -> None:
    sources = [SourceFrame(f"{k}.jpg", images / f"{k}.jpg") for k in range(3)]
    frames = [WorkFrame(source, f"{k:06d}.png", 60, 40, False, None) for k, source in enumerate(sources)]
    apart = job_of(frames, None, images, IngestConfig(shared_camera=False), 0, 1).exif_images
    assert apart == [(images / f"{k}.jpg").resolve() for k in range(3)]
    assert job_of(frames, None, images, IngestConfig(), 0, 1).exif_images == apart[:1]


def test_frames_of_one_lens_share_a_camera(tmp_path: Path) -> None:
    """A phone's main and wide camera give images of one size."""
    frames = []
    for index, focal in enumerate((28, 13, 28, 13)):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA405] = focal  # FocalLengthIn35mmFilm
        path = tmp_path / f"{index}.jpg"
        Image.new("RGB", (60, 40)).save(path, exif=exif)
        frames.append(WorkFrame(SourceFrame(path.name, path), f"{index:06d}.png", 60, 40, False, None))
    job = job_of(frames, None, tmp_path, IngestConfig(), 0, 1)
    assert job.camera_of == [0, 1, 0, 1] and len(job.exif_images) == 2


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_a_camera_that_fits_the_stored_image_keeps_it_so(tmp_path: Path, orientation: int) -> None:
    """COLMAP works on pixels as they are stored; half a turn keeps the proportions, and would go unseen."""
    pixels = np.random.default_rng(0).integers(0, 256, (4, 6, 4), np.uint8)
    path = tmp_path / "turned.png"
    write_oriented(path, pixels, orientation)
    camera = Intrinsics("PINHOLE", 6, 4, (5.0, 5.0, 3.0, 2.0))
    stored = read_image(SourceFrame("turned.png", path, camera=camera))
    assert np.array_equal(stored, pixels[..., :3])
    alone = SourceFrame("turned.png", path)
    turns = {1: 0, 3: 2, 6: 3}[orientation]
    assert np.array_equal(read_image(alone), np.rot90(pixels[..., :3], turns))
    source_mask = read_source_mask(alone)
    assert source_mask is not None and np.array_equal(source_mask > 0, np.rot90(pixels[..., 3] > 127, turns))


def write_oriented(path: Path, pixels: np.ndarray, orientation: int) -> None:
    """A PNG with EXIF's orientation."""
    spec = ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "uint8")
    spec.attribute("Orientation", orientation)
    spec.attribute("oiio:UnassociatedAlpha", 1)  # colours are not multiplied with it
    output = ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(pixels)
    output.close()


def test_externals_name_what_is_read(posed: Path, images: Path) -> None:
    config = IngestConfig()
    listed = {f"images/{index:03d}.png": posed / "images" / f"{index:03d}.png" for index in range(10)}
    assert externals(posed, config) == {"transforms": posed / "transforms.json", "images": listed}
    assert externals(images, config) == {"capture": pictures_of(images)}
    assert externals(images / "view0.png", config) == {"capture": images / "view0.png"}
    (posed / "masks").mkdir()
    (posed / "notes").mkdir()
    assert externals(posed, config)["masks"] == posed / "masks"
    assert set(externals(posed, config)) == {"transforms", "images", "masks"}
    # The folder of images alone has the same masks next to it.
    both = {"capture": pictures_of(posed / "images"), "masks": posed / "masks"}
    assert externals(posed / "images", config) == both


def test_exif_focal_length_is_the_starting_guess(tmp_path: Path) -> None:
    ok, jpeg = cv2.imencode(".jpg", np.zeros((40, 60, 3), np.uint8))
    assert ok
    # IFD0 -> Exif IFD at 26: FocalLengthIn35mmFilm = 28 mm.
    tiff = (
        b"MM\0*\0\0\0\x08\0\x01\x87\x69\0\x04\0\0\0\x01\0\0\0\x1a\0\0\0\0"
        b"\0\x01\xa4\x05\0\x03\0\0\0\x01\0\x1c\0\0\0\0\0\0"
    )
    body = b"Exif\0\0" + tiff
    data = jpeg.tobytes()
    path = tmp_path / "phone.jpg"
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:])
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 720.0, 600, 400)
    apply_exif_focal(camera, path)
    # A 35 mm film frame is 36 mm wide; COLMAP takes 35.
    assert camera.has_prior_focal_length and 0.97 < camera.params[0] / (600 * 28 / 36) < 1.04
    # Without EXIF the guess stays.
    cv2.imwrite(str(tmp_path / "plain.png"), np.zeros((40, 60, 3), np.uint8))
    other = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 720.0, 600, 400)
    apply_exif_focal(other, tmp_path / "plain.png")
    assert not other.has_prior_focal_length and other.params[0] == 720


def test_a_table_of_an_older_version_is_read(tmp_path: Path) -> None:
    """It lacks what frames came to say later; what every version says must be there."""
    old = pa.schema([column("a", pa.int32(), "old")])
    new = pa.schema([*old, column("b", pa.string(), "new", nullable=True)])
    write_table(tmp_path / "t.parquet", pa.table({"a": [1, 2]}), old)
    rows = read_table(tmp_path / "t.parquet", new).to_pylist()
    assert rows == [{"a": 1, "b": None}, {"a": 2, "b": None}]
    with pytest.raises(StoreError, match=r"t\.parquet"):
        read_table(tmp_path / "t.parquet", pa.schema([*old, column("c", pa.string(), "needed")]))


def turned_photo(path: Path, orientation: int, size: tuple[int, int]) -> None:
    exif = Image.Exif()
    exif[274] = orientation
    Image.new("RGB", size).save(path, exif=exif)


@pytest.mark.parametrize("size", [(60, 40), (50, 50)])
@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("form", ["a.png", "a.jpg.png"])
def test_a_mask_turns_with_its_image_if_it_was_made_on_the_stored_pixels(
    tmp_path: Path, size: tuple[int, int], orientation: int, form: str
) -> None:
    photo, mask = tmp_path / "a.jpg", tmp_path / form
    turned_photo(photo, orientation, size)
    stored = np.full(size[::-1], 255, np.uint8)
    stored[: size[1] // 4, : size[0] // 3] = 0
    tagged = Image.fromarray(stored)
    tagged.getexif()[274] = orientation
    upright = np.asarray(ImageOps.exif_transpose(tagged))
    frame = SourceFrame("a.jpg", photo, mask=mask)
    quarter = orientation >= 5 and size[0] != size[1]
    for pixels, fits in ((stored, quarter or form == "a.jpg.png"), (upright, quarter or form == "a.png")):
        cv2.imwrite(str(mask), pixels)
        if fits:
            found = read_source_mask(frame)
            assert found is not None and np.array_equal(found, upright)


def test_colmap_leaves_other_libraries_in_order() -> None:
    """Imported before numpy, pycolmap made a later save of Pillow abort."""
    code = (
        "import cleargs.capture.colmap\nfrom io import BytesIO\nfrom PIL import Image\n"
        "Image.new('RGB', (64, 64)).save(BytesIO(), 'png')"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
