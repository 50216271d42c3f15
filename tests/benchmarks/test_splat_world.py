"""A Gaussian scene as a world, with the cameras of its run or of a transforms.json."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from benchmarks.comparison.splat_world import CameraCourse, camera_course, scene_setup
from cleargs.capture.cameras import Pose
from cleargs.capture.tables import FRAMES
from cleargs.errors import InputError
from cleargs.parquet import write_table
from cleargs.progress import SilentReporter
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.ply import write_ply
from cleargs.splat.scene import Scene
from cleargs.synth.path import look_at
from cleargs.synth.synthetic_capture import make_capture

CAMERAS = 9


def real_poses() -> np.ndarray:
    """A path past the origin, camera to world [CAMERAS, 3, 4]."""
    centres = np.stack([np.linspace(-0.8, 0.8, CAMERAS), np.zeros(CAMERAS), np.full(CAMERAS, -3.0)], 1)
    return look_at(centres, np.zeros(3))


def scene(count: int = 300) -> Scene:
    generator = torch.Generator().manual_seed(0)
    return Scene(
        Gaussians(
            means=2 * torch.rand(count, 3, generator=generator) - 1,
            log_scales=torch.full((count, 3), -2.0),
            rotations=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
            logit_opacities=torch.full((count,), 2.0),
            sh=0.5 * torch.randn(count, 1, 3, generator=generator),
        )
    )


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run whose g0 is a link into the store, as in a run of the program."""
    store, run = tmp_path / "elsewhere" / "g0" / "key", tmp_path / "myrun"
    store.mkdir(parents=True)
    (run / "ingest").mkdir(parents=True)
    (run / "g0").symlink_to(store)
    write_ply(store / "scene.ply", scene())
    rows = []
    for number, pose in enumerate(real_poses()):
        world_to_camera = Pose(pose[:, :3].T, -pose[:, :3].T @ pose[:, 3])
        q, t = world_to_camera.quaternion, world_to_camera.translation
        rows.append(
            {
                **{"frame_id": number, "name": str(number), "image": "x.png", "time_s": None},
                **{"width": 120, "height": 90, "fx": 100.0, "fy": 100.0, "cx": 60.0, "cy": 45.0},
                **dict(zip(("qw", "qx", "qy", "qz"), q, strict=True)),
                **dict(zip(("tx", "ty", "tz"), t, strict=True)),
                **{"registered": True, "n_points": 0, "split": "train"},
            }
        )
    write_table(run / "ingest" / "frames.parquet", pa.Table.from_pylist(rows, FRAMES), FRAMES)
    return run


def test_capture_follows_the_cameras_of_the_run(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    summary = make_capture(
        out, "gsotm-mb-rs", frames=6, width=96, height=54, seed=0, reporter=SilentReporter(),
        setup=scene_setup(run / "g0" / "scene.ply", None, 6, 96, 54),
    )  # fmt: skip
    assert summary["world"] == "myrun"
    scale = 96 / 640
    assert summary["blur_px"]["mean"] == pytest.approx(8 * scale, abs=1e-3)
    assert summary["rolling_shutter_px"]["mean"] == pytest.approx(12 * scale, abs=1e-3)
    transforms = json.loads((out / "transforms.json").read_text())
    # 120x90 scaled to fill 96x54 is 96x72: a factor of 0.8, and 9 rows cropped above and below.
    assert [transforms[key] for key in ("fl_x", "fl_y", "cx", "cy")] == pytest.approx([80, 80, 48, 27])
    real = real_poses()[:, :, 3]
    for frame in transforms["frames"]:
        centre = np.array(frame["transform_matrix"])[:3, 3]
        # Cameras are 0.2 apart on a line, which smoothing does not change.
        assert np.linalg.norm(real - centre, axis=1).min() < 0.11
        assert abs(centre[1]) < 1e-6 and abs(centre[2] + 3) < 1e-6
    assert len(pq.read_table(out / "truth" / "frames.parquet")) == 6
    assert len(list((out / "truth" / "observed" / "depth").iterdir())) == 6


def test_course_avoids_a_gap() -> None:
    poses = real_poses()
    poses[:4, 0, 3] -= 5.0
    course = camera_course(list(poses), 5)
    first, last = course.poses(np.array([0.0, 1.0]))
    np.testing.assert_allclose([first[0, 3], last[0, 3]], [0.0, 0.8], atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(course.poses(np.linspace(0, 1, 7))[:, :, :3]), 1, atol=1e-12)


def test_cameras_from_a_transforms_file(tmp_path: Path) -> None:
    make_capture(tmp_path / "c", "sharp", frames=6, width=32, height=18, seed=0, reporter=SilentReporter())
    write_ply(tmp_path / "fox.ply", scene())
    with pytest.raises(InputError, match="is not in a run") as error:
        scene_setup(tmp_path / "fox.ply", None, 6, 32, 18)
    assert "--cameras" in error.value.hint
    for cameras in (tmp_path / "c", tmp_path / "c" / "transforms.json"):
        setting = scene_setup(tmp_path / "fox.ply", cameras, 6, 64, 36)
        lens = setting.lens
        assert setting.name == "fox" and (lens.width, lens.height) == (64, 36)
    assert isinstance(setting.course, CameraCourse) and setting.course.steps == 5
    with pytest.raises(InputError, match="7 frames cannot follow 6 cameras"):
        scene_setup(tmp_path / "fox.ply", tmp_path / "c", 7, 32, 18)
    with pytest.raises(InputError, match="contains no cameras"):
        scene_setup(tmp_path / "fox.ply", tmp_path / "nowhere", 6, 32, 18)


def test_invalid_scene_is_refused(run: Path, tmp_path: Path) -> None:
    path = run / "g0" / "scene.ply"
    write_ply(path, scene(0))
    with pytest.raises(InputError, match="contains no Gaussians"):
        scene_setup(path, None, 4, 32, 18)
    mesh = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n"
    for content in (b"not a ply", mesh.encode() + bytes(4), b""):
        path.write_bytes(content)
        with pytest.raises(InputError, match="is not a Gaussian scene") as error:
            scene_setup(path, None, 4, 32, 18)
        assert "\n" not in str(error.value) and error.value.hint
    with pytest.raises(InputError):
        scene_setup(tmp_path / "missing.ply", None, 4, 32, 18)


def test_camera_without_view_of_the_scene_is_refused(run: Path) -> None:
    setting = scene_setup(run / "g0" / "scene.ply", None, 6, 32, 18)
    away = setting.course.poses(np.array([0.5]))[0] @ np.diag([-1.0, 1.0, -1.0, 1.0])
    with pytest.raises(InputError, match="the scene is not visible in a frame"):
        setting.world.depth(away, setting.lens)
