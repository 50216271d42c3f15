"""A small synthetic capture with exact poses, made of textured planes, and a way to run the stage on it."""

from __future__ import annotations

import importlib
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cleargs.pipeline.stage import StageContext, StageResult
from cleargs.progress import SilentReporter
from cleargs.stages.ingest import IngestConfig

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
PLANES = ((4.0, -3.0, -2.5, 6.0), (3.0, -1.4, -0.9, 1.5), (2.5, 0.3, -0.3, 1.3))
"""Squares facing +z: depth, left, top, size. Far ones first, as painters work."""


class RecordingReporter(SilentReporter):
    """Keeps the warnings and the remarks."""

    def __init__(self) -> None:
        super().__init__()
        self.warnings: list[str] = []
        self.infos: list[str] = []

    def info(self, text: str) -> None:
        self.infos.append(text)

    def warn(self, text: str) -> None:
        self.warnings.append(text)


@dataclass
class Ingested:
    out: Path
    result: StageResult
    warnings: list[str]
    infos: list[str]


Ingest = Callable[..., Ingested]


def ingest_in(tmp_path: Path, cache: Path | None = None) -> Ingest:
    """Return a function that runs the stage in a folder: ``ingest(source, name, threads=1, **settings)``.

    ``cache`` is the folder of the models that ingest has found before (None: ``kept`` below ``tmp_path``). A
    test that compares two calculations of the same names two folders.
    """

    def run(
        source: Path, name: str = "out", *, threads: int = 1, kept: str = "kept", **settings: Any
    ) -> Ingested:
        out, work = tmp_path / name, tmp_path / f"{name}.work"
        out.mkdir(exist_ok=True)
        work.mkdir(exist_ok=True)
        reporter = RecordingReporter()
        context = StageContext(
            # A quarter of the default: enough for these small images, and four times as fast to match.
            config=IngestConfig(**{"max_features": 1024, **settings}),
            source=source,
            inputs={},
            externals={},
            out=out,
            checkpoints=work,
            cache=cache or tmp_path / kept,
            seed=0,
            device="cpu",
            threads=threads,
            reporter=reporter,
        )
        stage = importlib.import_module("cleargs.stages.ingest")
        return Ingested(out, stage.run(context), reporter.warnings, reporter.infos)

    return run


@pytest.fixture
def ingest(tmp_path: Path) -> Ingest:
    """Run the stage: see `ingest_in`."""
    return ingest_in(tmp_path)


def camera_to_world(count: int) -> list[NDArray[np.float64]]:
    """OpenCV camera-to-world matrices along an arc in front of the planes."""
    poses = []
    for index in range(count):
        t = index / (count - 1) - 0.5
        centre = np.array([2.4 * t, 0.5 * np.sin(5 * t), 0.4 * np.cos(4 * t)])
        forward = np.array([0.2, 0.0, 3.5]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = centre
        poses.append(pose)
    return poses


def texture(seed: int, size: int = 512) -> NDArray[np.uint8]:
    """Blotches of several sizes: corners at every scale."""
    random = np.random.default_rng(seed)
    total = np.zeros((size, size, 3), np.float32)
    for cells in (8, 24, 64, 160):
        noise = random.random((cells, cells, 3)).astype(np.float32)
        total += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    total -= total.min()
    return (255 * total / total.max()).astype(np.uint8)


def render(pose: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The planes seen by a camera, supersampled twice."""
    scale = 2
    image = np.full((scale * HEIGHT, scale * WIDTH, 3), 90, np.uint8)
    k = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    zoom = np.array([[scale, 0, -0.5], [0, scale, -0.5], [0, 0, 1]])
    world_to_camera = np.linalg.inv(pose)
    for index, (depth, left, top, size) in enumerate(PLANES):
        picture = texture(index)
        cell = size / picture.shape[0]
        # Texture pixel (column, row, 1) to world: a plane of constant z.
        to_world = np.array([[cell, 0, left + cell / 2], [0, cell, top + cell / 2], [0, 0, depth]])
        to_camera = world_to_camera[:3, :3] @ to_world + np.outer(world_to_camera[:3, 3], [0, 0, 1])
        homography = zoom @ k @ to_camera
        shape = (scale * WIDTH, scale * HEIGHT)
        warped = cv2.warpPerspective(picture, homography, shape)
        inside = cv2.warpPerspective(np.full(picture.shape[:2], 255, np.uint8), homography, shape)
        image = np.where(inside[..., None] > 127, warped, image)
    return np.asarray(cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))


@pytest.fixture(scope="session")
def frames() -> list[tuple[NDArray[np.float64], NDArray[np.uint8]]]:
    """Pose (OpenCV camera to world) and BGR image of each frame."""
    return [(pose, render(pose)) for pose in camera_to_world(10)]


def images_in(tmp_path: Path, frames: list[tuple[NDArray[np.float64], NDArray[np.uint8]]]) -> Path:
    """Write a folder of images alone."""
    folder = tmp_path / "images-only"
    folder.mkdir()
    for index, (_, image) in enumerate(frames):
        cv2.imwrite(str(folder / f"view{index}.png"), image)
    return folder


@pytest.fixture
def images(tmp_path: Path, frames: list[tuple[NDArray[np.float64], NDArray[np.uint8]]]) -> Path:
    """A folder of images alone."""
    return images_in(tmp_path, frames)


@pytest.fixture(scope="session")
def placed(
    tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[NDArray[np.float64], NDArray[np.uint8]]]
) -> Ingested:
    """Results of the folder `images` with the settings of `ingest`, made once. Tests only read them."""
    folder = tmp_path_factory.mktemp("placed")
    return ingest_in(folder)(images_in(folder, frames))


def posed_in(tmp_path: Path, frames: list[tuple[NDArray[np.float64], NDArray[np.uint8]]]) -> Path:
    """Write a folder with images/ and transforms.json."""
    folder = tmp_path / "posed"
    (folder / "images").mkdir(parents=True)
    for index, (_, image) in enumerate(frames):
        cv2.imwrite(str(folder / "images" / f"{index:03d}.png"), image)
    write_transforms(folder, [pose for pose, _ in frames])
    return folder


@pytest.fixture
def posed(tmp_path: Path, frames: list[tuple[NDArray[np.float64], NDArray[np.uint8]]]) -> Path:
    """A folder with images/ and transforms.json."""
    return posed_in(tmp_path, frames)


@pytest.fixture(scope="session")
def made(
    tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[NDArray[np.float64], NDArray[np.uint8]]]
) -> Ingested:
    """Results of the folder `posed` with the settings of `ingest`, made once. Tests only read them."""
    folder = tmp_path_factory.mktemp("made")
    return ingest_in(folder)(posed_in(folder, frames))


@pytest.fixture
def first(made: Ingested, tmp_path: Path) -> Path:
    """A copy of the results of `made`, which the test may change."""
    return Path(shutil.copytree(made.out, tmp_path / "first"))


def write_transforms(folder: Path, poses: list[NDArray[np.float64]], **extra: Any) -> None:
    """transforms.json of OpenGL camera-to-world matrices."""
    entries = [
        {
            "file_path": f"images/{index:03d}.png",
            "transform_matrix": (pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
        }
        for index, pose in enumerate(poses)
    ]
    data = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, **extra}
    (folder / "transforms.json").write_text(json.dumps({**data, "frames": entries}))
