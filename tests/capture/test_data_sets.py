"""The layouts of the data sets that the paper and its peers use, each as a small folder made here."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cleargs.capture.cameras import Pose
from cleargs.capture.capture import Capture
from cleargs.capture.choice import held_out
from cleargs.capture.layouts.llff import read_llff, read_poses_bounds
from cleargs.capture.model import write_model
from cleargs.capture.sources import externals, open_capture
from cleargs.capture.tables import load_frames
from cleargs.digest import named_files
from cleargs.errors import InputError
from cleargs.stages.ingest import IngestConfig

from .conftest import FOCAL, HEIGHT, WIDTH, Ingest, camera_to_world
from .test_parts import small_model

Frames = list[tuple[NDArray[np.float64], NDArray[np.uint8]]]


def poses_bounds(poses: list[NDArray[np.float64]], width: int = WIDTH, scale: float = 1.0) -> Any:
    """Rows as LLFF's save_poses and Deblur-NeRF's synthe2poses.py write them; [N, 17]."""
    rows = []
    for pose in poses:
        right, down, forward = scale * pose[:3, 0], scale * pose[:3, 1], scale * pose[:3, 2]
        size = np.array([width * HEIGHT / WIDTH, width, FOCAL * width / WIDTH])
        matrix = np.stack([down, right, -forward, pose[:3, 3], size], axis=1)
        rows.append(np.concatenate([matrix.ravel(), [1.0, 9.0]]))
    return np.stack(rows)


def write_images(folder: Path, names: list[str], shrink: int = 1) -> None:
    folder.mkdir(parents=True)
    for index, name in enumerate(names):
        picture = np.full((HEIGHT // shrink, WIDTH // shrink, 3), index, np.uint8)
        cv2.imwrite(str(folder / name), picture)


def agree(pose: Pose | None, camera_to_world: NDArray[np.float64]) -> bool:
    assert pose is not None
    world_to_camera = np.linalg.inv(camera_to_world)
    return np.allclose(pose.rotation, world_to_camera[:3, :3], atol=1e-6) and np.allclose(
        pose.translation, world_to_camera[:3, 3], atol=1e-6
    )


def held_out_names(capture: Capture, rule: str) -> list[str]:
    """Names of the frames that ``rule`` holds out."""
    names = [frame.name for frame in capture.frames]
    chosen = held_out(rule, names, lambda _: np.zeros((1, 1, 3), np.uint8), [True] * len(names))
    return [names[index] for index in sorted(chosen)]


# -- Deblur-NeRF and LLFF ----------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_llff_poses_are_those_planted(tmp_path: Path, scale: float) -> None:
    # Blender's matrices carry the scale of the object: Deblur-NeRF's synthetic scenes have it in their rows.
    poses = camera_to_world(12)
    names = [f"{index:03d}.png" for index in range(12)]
    write_images(tmp_path / "images", names)
    write_images(tmp_path / "images_4", names, shrink=4)
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(poses, width=2 * WIDTH, scale=scale))
    capture = open_capture(tmp_path, IngestConfig())
    assert capture.kind == "llff" and capture.posed and [frame.name for frame in capture.frames] == names
    for frame, pose in zip(capture.frames, poses, strict=True):
        assert agree(frame.pose, pose)
        assert frame.path.parent == tmp_path / "images"
        # The poses were made at twice the size of the images.
        assert frame.camera is not None
        camera = frame.camera.resized(WIDTH, HEIGHT)
        assert (camera.model, camera.params) == ("PINHOLE", (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
    # hold=7 next to the images: every seventh image is a sharp test view.
    (tmp_path / "hold=7").touch()
    assert held_out_names(capture, "every:7") == ["000.png", "007.png"]
    roles = {"poses_bounds": "poses_bounds.npy", "images": "images", "images_4": "images_4"}
    assert externals(tmp_path, IngestConfig()) == {role: tmp_path / name for role, name in roles.items()}


def test_llff_rows_follow_sorted_names(tmp_path: Path) -> None:
    # LLFF pairs rows and images by sorted(), in which 10 comes before 2; test views are every N-th row.
    names = [f"{index}.jpg" for index in range(11)]
    write_images(tmp_path / "images", names)
    (tmp_path / "images" / "notes.txt").write_text("not an image")
    poses = camera_to_world(11)
    by_name = dict(zip(names, poses, strict=True))
    np.save(tmp_path / "poses_bounds.npy", poses_bounds([by_name[name] for name in sorted(names)]))
    capture = open_capture(tmp_path, IngestConfig())
    assert [frame.name for frame in capture.frames] == sorted(names)
    assert all(agree(frame.pose, by_name[frame.name]) for frame in capture.frames)
    assert held_out_names(capture, "every:5") == ["0.jpg", "4.jpg", "9.jpg"]


def test_llff_folder_with_as_many_images_as_rows(tmp_path: Path) -> None:
    # Releases of the synthetic scenes: images_1/ has all, images/ the blurred ones, images_test/ sharp ones.
    names = [f"{index:03d}.png" for index in range(9)]
    write_images(tmp_path / "images_1", names)
    write_images(tmp_path / "images_test", names[:8])
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(camera_to_world(9)))
    assert {view.path.parent.name for view in read_llff(tmp_path)} == {"images_1"}
    write_images(tmp_path / "images", names[1:])
    assert {view.path.parent.name for view in read_llff(tmp_path)} == {"images_1"}
    write_images(tmp_path / "images_2", names, shrink=2)
    assert {view.path.parent.name for view in read_llff(tmp_path)} == {"images_1"}
    (tmp_path / "images" / "000.png").write_bytes((tmp_path / "images_1" / "000.png").read_bytes())
    assert {view.path.parent.name for view in read_llff(tmp_path)} == {"images"}


def test_llff_counts_that_differ(tmp_path: Path) -> None:
    write_images(tmp_path / "images", [f"{index:03d}.png" for index in range(9)])
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(camera_to_world(10)))
    with pytest.raises(InputError, match=r"has 10 poses.*images/ 9") as caught:
        open_capture(tmp_path, IngestConfig())
    assert caught.value.hint and "ingest.poses=sfm" in caught.value.hint
    # Without its poses it is a folder of images, and the file is not even looked at.
    (tmp_path / "poses_bounds.npy").write_bytes(b"")
    config = IngestConfig(poses="sfm")
    capture = open_capture(tmp_path, config)
    assert capture.kind == "images" and not capture.posed and len(capture.frames) == 9
    assert list(externals(tmp_path, config)) == ["images"]
    (tmp_path / "images").rename(tmp_path / "images_1")
    assert len(open_capture(tmp_path, config).frames) == 9
    with pytest.raises(InputError, match="cannot read"):
        open_capture(tmp_path, IngestConfig())


def test_llff_beside_a_sparse_model(tmp_path: Path) -> None:
    # NeRF's LLFF scenes come with the COLMAP model their poses are from: it has points and distortion too.
    write_images(tmp_path / "images", ["a1.png", "a2.png", "a3.png"])
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(camera_to_world(3)))
    model = small_model()
    write_model(tmp_path / "sparse" / "0", model, np.zeros((4, 3), np.uint8))
    for image in model.images.values():
        (tmp_path / "images" / image.name).touch()
    assert open_capture(tmp_path, IngestConfig()).kind == "colmap"


@pytest.mark.parametrize(
    ("row", "column", "value", "words"),
    [
        (4, 0, np.nan, r"004\.png in poses_bounds\.npy is not finite"),
        (4, 3, np.inf, r"004\.png"),
        (4, 14, 0.0, r"004\.png"),
        (4, 9, -5.0, r"004\.png"),
        (2, 0, 40.0, r"002\.png is not a rotation"),
    ],
)
def test_llff_bad_rows(tmp_path: Path, row: int, column: int, value: float, words: str) -> None:
    write_images(tmp_path / "images", [f"{index:03d}.png" for index in range(6)])
    table = poses_bounds(camera_to_world(6))
    table[:, 15:] = np.nan  # the depth bounds are not needed
    np.save(tmp_path / "poses_bounds.npy", table)
    open_capture(tmp_path, IngestConfig())
    table[row, column] = value
    np.save(tmp_path / "poses_bounds.npy", table)
    with pytest.raises(InputError, match=words) as caught:
        open_capture(tmp_path, IngestConfig())
    assert "\n" not in str(caught.value) and caught.value.hint


@pytest.mark.parametrize(
    "table",
    [
        np.zeros((6, 15)),
        np.zeros(17),
        np.zeros((6, 17), bool),
        np.array([{"a": 1}, None], object),
        np.zeros((6, 17), np.complex128),
    ],
    ids=["no bounds", "one row", "flags", "pickled", "complex"],
)
def test_arrays_that_are_no_poses(tmp_path: Path, table: NDArray[Any]) -> None:
    path = tmp_path / "poses_bounds.npy"
    np.save(path, table, allow_pickle=True)
    with pytest.raises(InputError, match="cannot read") as caught:
        read_poses_bounds(path)
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("error")
def test_an_array_that_python_2_wrote_is_read_without_a_word(tmp_path: Path) -> None:
    path = tmp_path / "poses_bounds.npy"
    np.save(path, np.ones((6, 17)))
    path.write_bytes(path.read_bytes().replace(b"(6, 17), }  ", b"(6L, 17L), }"))
    assert read_poses_bounds(path).shape == (6, 17)


def test_damaged_poses_bounds(tmp_path: Path) -> None:
    path = tmp_path / "poses_bounds.npy"
    np.save(path, poses_bounds(camera_to_world(6)))
    whole = path.read_bytes()
    random = np.random.default_rng(0)
    damaged = [whole[:length] for length in (0, 4, 9, 60, 128, len(whole) - 1)]
    # A flipped bit in the header (128 bytes): refused, or harmless padding, but never another kind of error.
    for place, bit in zip(random.integers(0, 128, 200), random.integers(0, 8, 200), strict=True):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(bit)
        damaged.append(bytes(flipped))
    refused = 0
    for data in damaged:
        path.write_bytes(data)
        try:
            assert read_poses_bounds(path).shape[1] == 17
        except InputError as error:
            assert "\n" not in str(error) and error.hint
            refused += 1
    assert refused > 100


def test_llff_capture_is_ingested(tmp_path: Path, frames: Frames, ingest: Ingest) -> None:
    source = tmp_path / "blurscene"
    (source / "images_1").mkdir(parents=True)
    for index, (_, image) in enumerate(frames):
        cv2.imwrite(str(source / "images_1" / f"{index:03d}.png"), image)
    np.save(source / "poses_bounds.npy", poses_bounds([pose for pose, _ in frames]))
    done = ingest(source, holdout="every:4")
    summary = done.result.summary
    assert summary["kind"] == "llff" and summary["poses"] == "given"
    # True poses triangulate to well below a pixel; wrong axes would leave almost no points.
    assert summary["registered"] == 10 and summary["points"] > 200
    assert summary["mean_reprojection_error_px"] < 1
    rows = load_frames(done.out)
    assert [row.name for row in rows if row.split == "test"] == ["000.png", "004.png", "008.png"]
    assert summary["test"] == 3 and len(summary["holdout_hash"]) == 64
    other = ingest(source, "other", holdout="every:5")
    assert other.result.summary["holdout_hash"] != summary["holdout_hash"]


# -- Gaussian Splatting on the Move ------------------------------------------------------------------------


def gsotm(folder: Path, names: list[str], order: list[int], **extra: Any) -> list[NDArray[np.float64]]:
    """A case of the processed data, its frames listed in ``order``; returns the poses."""
    poses = camera_to_world(len(names))
    write_images(folder / "images", names)
    entries = [
        {
            "camera_linear_velocity": [0.1, 0.0, -0.2],
            "camera_angular_velocity": [0.0, 0.3, 0.0],
            "motion_blur_score": 0.5 + 0.01 * index,
            "colmap_im_id": index + 1,
            "depth_file_path": f"./depth/{index}.png",
            "file_path": f"./images/{names[index]}",
            "transform_matrix": (poses[index] @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
        }
        for index in order
    ]
    data = {
        "aabb_scale": 16,
        "w": WIDTH,
        "h": HEIGHT,
        "cx": WIDTH / 2,
        "cy": HEIGHT / 2,
        "fl_x": FOCAL,
        "fl_y": FOCAL,
        "k1": 0,
        "k2": 0,
        "p1": 0,
        "p2": 0,
        "orientation_override": "none",
        "auto_scale_poses_override": False,
        "exposure_time": 0.01,
        "rolling_shutter_time": 0.02,
        "ply_file_path": "./sparse_pc.ply",
        "applied_transform": [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]],
        "frames": entries,
        **extra,
    }
    (folder / "transforms.json").write_text(json.dumps(data))
    (folder / "sparse_pc.ply").write_text("ply\n")
    return poses


def test_gsotm_synthetic(tmp_path: Path) -> None:
    names = [f"{index:03d}.png" for index in range(17)]
    order = np.random.default_rng(0).permutation(17).tolist()
    poses = gsotm(tmp_path, names, order)
    capture = open_capture(tmp_path, IngestConfig())
    assert capture.kind == "transforms" and [Path(frame.name).name for frame in capture.frames] == names
    for frame, pose in zip(capture.frames, poses, strict=True):
        assert agree(frame.pose, pose)
        assert frame.camera is not None and frame.camera.params == (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    # Every eighth is rendered without blur, as a test view (nerfstudio's eval-interval).
    assert held_out_names(capture, "every:8") == ["images/000.png", "images/008.png", "images/016.png"]
    read = externals(tmp_path, IngestConfig())
    assert read["transforms"] == tmp_path / "transforms.json"
    assert set(named_files(read["images"]).values()) == {tmp_path / "images" / name for name in names}


def test_gsotm_smartphone(tmp_path: Path) -> None:
    # Blur-scored sets: the frame of least blur of every eight was renamed to eval_, all others to train_.
    tests = {3, 8, 19}
    names = [f"{'eval' if i in tests else 'train'}_frame_{i + 1:05d}.png" for i in range(20)]
    lens = {"k1": 0.05, "k2": -0.02, "p1": 0.001, "p2": 0.0, "k3": 0.01, "camera_model": "OPENCV"}
    poses = gsotm(tmp_path, names, list(range(20)), **lens)
    data = json.loads((tmp_path / "transforms.json").read_text())
    for index, entry in enumerate(data["frames"]):
        # The phone's autofocus: a focal length a frame.
        entry |= {"fl_x": FOCAL + index, "fl_y": FOCAL + index, "cx": 161.0, "cy": 119.0}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    capture = open_capture(tmp_path, IngestConfig())
    assert [Path(frame.name).name for frame in capture.frames] == names
    assert held_out_names(capture, "eval_*") == [f"images/{names[index]}" for index in sorted(tests)]
    for index, (frame, pose) in enumerate(zip(capture.frames, poses, strict=True)):
        assert agree(frame.pose, pose)
        assert frame.camera is not None and frame.camera.model == "FULL_OPENCV"
        assert frame.camera.focal == (FOCAL + index,) * 2 and frame.camera.centre == (161.0, 119.0)


# -- GS2E --------------------------------------------------------------------------------------------------


def test_gs2e_as_data_readme_arranges_it(tmp_path: Path) -> None:
    for level in ("slight", "medium", "severe", "sharp"):
        gsotm(tmp_path / level, [f"{index:05d}.png" for index in range(6)], list(range(6)))
    captures = {level: open_capture(tmp_path / level, IngestConfig()) for level in ("medium", "sharp")}
    # The sharp frames are the same stems at the same poses in the same world, so that they can be references.
    for blurred, sharp in zip(captures["medium"].frames, captures["sharp"].frames, strict=True):
        assert blurred.name == sharp.name and blurred.path != sharp.path
        assert blurred.pose is not None and sharp.pose is not None
        assert np.array_equal(blurred.pose.rotation, sharp.pose.rotation)
    read = externals(tmp_path / "medium", IngestConfig())["images"]
    assert {file.parent for file in named_files(read).values()} == {tmp_path / "medium" / "images"}
