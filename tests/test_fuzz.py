"""Readers of mutated files: they either return or raise an error of one line, in a short time.

A run of the tests uses the same 60 mutations per reader. ``make fuzz SEED=7`` draws 2000 mutations per
reader, which depend only on the seed.
"""

from __future__ import annotations

import json
import os
import struct
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cleargs.batch.sheet import read_scenes
from cleargs.capture.cameras import Pose, Similarity, pinhole
from cleargs.capture.layouts.llff import read_poses_bounds
from cleargs.capture.layouts.transforms import read_transforms
from cleargs.capture.model import ModelImage, SparseModel, read_model, write_model
from cleargs.capture.sources import externals
from cleargs.errors import CleargsError
from cleargs.files import write_json
from cleargs.formation.exposure import EXPOSURE
from cleargs.manifest import read_manifest
from cleargs.media.encode import write_video
from cleargs.media.exr import LayeredImage, read_exr, write_exr
from cleargs.media.image import read_rgb
from cleargs.media.video import read_timeline
from cleargs.parquet import read_table, write_table
from cleargs.pipeline.config import read_toml
from cleargs.progress import SilentReporter
from cleargs.render.shots import read_poses
from cleargs.splat.camera import Camera
from cleargs.splat.formats import FORMATS, read_scene, write_scene
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.ply import read_ply, write_ply
from cleargs.splat.scene import Scene
from cleargs.splat.state import load_state, save_state
from cleargs.stages.ingest import IngestConfig

EXAMPLES = int(os.environ.get("CLEARGS_FUZZ", "60"))

INTERESTING = [
    *(b"", b"\0", b"\xff\xff\xff\xff", b"\x7f" * 8, b"\n", b" ", b'"', b"-", b"[", b"{", b"1e308", b"NaN"),
    *(b"Infinity", b"-1", b"9" * 30, b"9" * 400, b"\\u0000", b"null", b"[" * 3000, b'{"a":' * 3000),
    *(struct.pack("<d", value) for value in (np.nan, np.inf, 1e300, -0.0, 5e-324)),
    *(struct.pack("<Q", value) for value in (2**63, 2**60, 2**32, 2**64 - 1)),
]


@st.composite
def mutations(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """A few edits: bytes are flipped, or parts are cut, doubled or replaced by an interesting value."""
    edits = draw(
        st.lists(
            st.tuples(
                st.floats(0, 1, exclude_max=True),
                st.sampled_from(["flip", "cut", "insert", "replace", "double", "end", "number"]),
                st.integers(0, 255),
                st.integers(1, 40),
                st.sampled_from(INTERESTING),
            ),
            min_size=1,
            max_size=4,
        )
    )

    def mutate(data: bytes) -> bytes:
        for where, how, value, length, piece in edits:
            at = int(where * max(1, len(data)))
            before, after = data[:at], data[at:]
            data = {
                "flip": lambda: before + bytes([value]) + after[1:],  # noqa: B023
                "cut": lambda: before + after[length:],  # noqa: B023
                "insert": lambda: before + piece + after,  # noqa: B023
                "replace": lambda: before + piece + after[len(piece) :],  # noqa: B023
                "double": lambda: before + after[:length] + after,  # noqa: B023
                "end": lambda: before,  # noqa: B023
                "number": lambda: _number(data, at, piece),  # noqa: B023
            }[how]()
        return data

    return mutate


def _number(data: bytes, at: int, piece: bytes) -> bytes:
    """Replace the next number in a text."""
    start = next((k for k in range(at, len(data)) if 48 <= data[k] < 58), len(data))
    end = next((k for k in range(start, len(data)) if data[k] not in b"0123456789.eE+-"), len(data))
    return data[:start] + piece + data[end:]


def model(folder: Path) -> None:
    turn = np.eye(3)
    cameras = {1: pinhole(64, 48, 50.0, 50.0, 32.0, 24.0)}
    ids = np.array([3, 5, 9], np.int64)
    images = {
        k: ModelImage(f"{k}.png", 1, Pose(turn, np.array([0.1 * k, 0, 1.0])), np.full((3, 2), 8.0 + k), ids)
        for k in (1, 2, 3)
    }
    points = SparseModel(cameras, images, ids, np.arange(9.0).reshape(3, 3), np.full(3, 0.5))
    write_model(folder, points, np.full((3, 3), 128, np.uint8))


def text_model(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("# cameras\n1 OPENCV 64 48 50 50 32 24 0.1 0 0 0\n")
    (folder / "images.txt").write_text(
        "1 1 0 0 0 0.1 0 1 1 a b.png\n8 9 3 10 11 -1\n2 1 0 0 0 0.2 0 1 1 c.png\n\n"
    )
    (folder / "points3D.txt").write_text("3 0.5 1.5 2.5 128 128 128 0.7 1 0\n")


def transforms(folder: Path) -> None:
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "a.png"), np.zeros((4, 6, 3), np.uint8))
    frame = {"file_path": "a.png", "mask_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    common = {"w": 6, "h": 4, "fl_x": 5.0, "camera_angle_y": 0.8, "cx": 3.0, "k1": 0.1, "p2": 0.01}
    (folder / "transforms.json").write_text(json.dumps({**common, "frames": [frame, frame]}))


def read_capture(folder: Path) -> object:
    externals(folder, IngestConfig())
    return read_transforms(folder / "transforms.json", poses=True)


def scene() -> Scene:
    return Scene(
        Gaussians(
            means=torch.zeros(2, 3),
            log_scales=torch.zeros(2, 3),
            rotations=torch.ones(2, 4),
            logit_opacities=torch.zeros(2),
            sh=torch.zeros(2, 4, 3),
        )
    )


def exr(folder: Path) -> None:
    folder.mkdir()
    pixels = np.linspace(0, 1, 8 * 6 * 3).reshape(6, 8, 3).astype(np.float16)
    write_exr(folder / "a.exr", LayeredImage({"render": pixels}, {"cleargs:frame": 3, "cleargs:reason": "x"}))


def pictures(folder: Path) -> None:
    folder.mkdir()
    for suffix in ("png", "jpg", "webp", "tif", "bmp"):
        cv2.imwrite(str(folder / f"a.{suffix}"), np.full((9, 13, 3), 77, np.uint8))


def sheets(folder: Path) -> None:
    folder.mkdir()
    (folder / "s.toml").write_text(
        'recipe = "smoke"\n[set]\ng0.steps = 5\n[[scene]]\nname = "a"\ninput = "."\n'
    )
    (folder / "s.csv").write_text("name,input,g0.steps,resources.g0.minutes\na,.,5,9\nb,.,,\n")


def manifests(folder: Path) -> None:
    folder.mkdir()
    (folder / "manifest.json").write_text(json.dumps({"stage": "g0", "files": {}, "seal": "0" * 64}))
    (folder / "run.toml").write_text('input = "x"\nseed = 0\n[g0]\nsteps = 3\n')


def npy(folder: Path) -> None:
    folder.mkdir()
    np.save(folder / "poses_bounds.npy", np.ones((3, 17)))


SAME = Similarity(np.eye(3), np.zeros(3), 1.0)
LENS = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))


def poses(folder: Path) -> None:
    folder.mkdir()
    place = {
        "rotation": np.eye(3).tolist(),
        "position": [0.1, 0.2, 0.3],
        "width": 64,
        "height": 48,
        "fx": 50.0,
    }
    write_json(folder / "cameras.json", [place, place])
    frame = {"transform_matrix": np.eye(4).tolist()}
    write_json(folder / "transforms.json", {"w": 64, "h": 48, "fl_x": 50.0, "frames": [frame, frame]})


def tables(folder: Path) -> None:
    folder.mkdir()
    rows = [dict.fromkeys(EXPOSURE.names, 0.5) | {"frame_id": k} for k in range(3)]
    write_table(folder / "t.parquet", pa.Table.from_pylist(rows, EXPOSURE), EXPOSURE)
    save_state(folder / "t.safetensors", {"step": torch.tensor(3), "means": torch.zeros(4, 3)})


def read_stored(file: Path) -> object:
    return read_table(file, EXPOSURE) if file.suffix == ".parquet" else load_state(file, SilentReporter())


def video(folder: Path) -> None:
    folder.mkdir()
    frames = (np.full((48, 64, 3), 40 * k, np.uint8) for k in range(4))
    write_video(folder / "v.mp4", frames, 10.0)


def read_manifest_or_none(folder: Path) -> object:
    with suppress(ValueError, FileNotFoundError):  # its callers treat these as damage
        return read_manifest(folder)
    return None


def ply(folder: Path) -> None:
    folder.mkdir()
    write_ply(folder / "a.ply", scene())


def scenes(folder: Path) -> None:
    folder.mkdir()
    for kind in sorted(set(FORMATS) - {"usdc"}):
        write_scene(folder / f"a.{kind}", scene(), kind)


def all_of(read: Callable[[Path], object], pattern: str) -> Callable[[Path], object]:
    def each(folder: Path) -> object:
        for file in sorted(folder.glob(pattern)):
            with suppress(CleargsError):
                read(file)
        return None

    return each


READERS: dict[str, tuple[Callable[[Path], None], Callable[[Path], object]]] = {
    "COLMAP binary": (model, read_model),
    "COLMAP text": (text_model, read_model),
    "transforms.json": (transforms, read_capture),
    "LLFF": (npy, lambda folder: read_poses_bounds(folder / "poses_bounds.npy")),
    "scenes": (scenes, all_of(read_scene, "a.*")),
    "PLY": (ply, lambda folder: read_ply(folder / "a.ply")),
    "EXR": (exr, lambda folder: read_exr(folder / "a.exr", "cleargs:")),
    "images": (pictures, all_of(read_rgb, "a.*")),
    "sheets": (sheets, all_of(read_scenes, "s.*")),
    "manifest": (manifests, read_manifest_or_none),
    "poses": (poses, all_of(lambda file: read_poses(file, LENS, SAME), "*.json")),
    "tables, checkpoints": (tables, all_of(read_stored, "t.*")),
    "video": (video, lambda folder: read_timeline(folder / "v.mp4")),
    "run.toml": (manifests, lambda folder: read_toml(folder / "run.toml")),
}


@pytest.fixture(scope="module")
def originals() -> Iterator[dict[str, Path]]:
    with tempfile.TemporaryDirectory() as root:
        folders = {name: Path(root, str(number)) for number, name in enumerate(READERS)}
        for name, folder in folders.items():
            READERS[name][0](folder)
        yield folders


@pytest.mark.parametrize("name", READERS)
def test_the_unchanged_file_is_read(originals: dict[str, Path], name: str) -> None:
    READERS[name][1](originals[name])


@pytest.mark.parametrize("name", READERS)
def test_a_mutated_file_is_read_or_refused(originals: dict[str, Path], name: str) -> None:
    folder = originals[name]
    files = {file: file.read_bytes() for file in sorted(folder.iterdir())}
    _, read = READERS[name]

    @settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck), derandomize=EXAMPLES == 60)
    @given(mutate=mutations(), which=st.integers(0, len(files) - 1))
    def check(mutate: Callable[[bytes], bytes], which: int) -> None:
        file = list(files)[which]
        file.write_bytes(mutate(files[file]))
        try:
            read(folder)
        except CleargsError as error:
            assert "\n" not in str(error) and error.hint
        finally:
            file.write_bytes(files[file])

    check()
