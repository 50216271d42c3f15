"""A small scene, references rendered from it, and the folders of a run around it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cleargs.capture.cameras import Pose, Similarity
from cleargs.capture.tables import FRAMES, load_frames
from cleargs.digest import DigestMemo, file_digest
from cleargs.evaluate.config import EvalOptions
from cleargs.formation.exposure import Exposure, write_exposure
from cleargs.manifest import FileRecord, KeyParts, Manifest, linked_manifest, published_files, write_manifest
from cleargs.media.image import to_uint8, write_mask, write_rgb
from cleargs.parquet import write_table
from cleargs.pipeline.config import check_document
from cleargs.pipeline.keys import key_config
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import RunSpec, read_run_file, write_run_file
from cleargs.pipeline.stages import installed
from cleargs.pipeline.store import Store
from cleargs.progress import SilentReporter
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.ply import write_ply
from cleargs.splat.render import render
from cleargs.splat.scene import Scene

WIDTH, HEIGHT, FOCAL = 96, 72, 90.0
WORLD = Similarity(
    Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix(), np.array([3.0, -7, 2]), 2.5
)
"""From the input's world to the run's."""

PLAIN = EvalOptions(lpips=(), scorers=())
"""PSNR and SSIM alone."""


@dataclass
class Remarks(SilentReporter):
    """Keep the messages."""

    infos: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def info(self, text: str) -> None:
        self.infos.append(text)

    def warn(self, text: str) -> None:
        self.warnings.append(text)


def make_scene(seed: int = 0, count: int = 300) -> Scene:
    """Opaque coloured blobs that fill the views of `cameras`."""
    rng = np.random.default_rng(seed)
    sh = np.zeros((count, 1, 3))
    sh[:, 0] = rng.uniform(-1.5, 1.5, (count, 3))
    arrays = (
        rng.uniform([-2.5, -2, 3], [2.5, 2, 5], (count, 3)),
        np.log(rng.uniform(0.08, 0.4, (count, 3))),
        rng.normal(size=(count, 4)),
        np.full(count, 3.0),
        sh,
    )
    gaussians = Gaussians(*(torch.tensor(array, dtype=torch.float32) for array in arrays))
    return Scene(gaussians, background=(0.2, 0.3, 0.4))


def cameras(count: int = 6) -> list[Camera]:
    """Cameras on a winding path, looking at the scene."""
    found = []
    for t in np.linspace(0, 1, count):
        centre = np.array([0.8 * t - 0.4, 0.2 * np.sin(7 * t), 0.3 * np.cos(5 * t)])
        rotation = Rotation.from_euler("yx", [6 - 12 * t, 3 * np.sin(9 * t)], degrees=True).as_matrix()
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
        found.append(Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose))
    return found


def picture(scene: Scene, camera: Camera) -> NDArray[np.uint8]:
    image = render(scene.gaussians, camera, background=scene.background).image
    return to_uint8(image.numpy())


def to_input(camera: Camera, similarity: Similarity = WORLD) -> NDArray[np.float64]:
    """The OpenGL camera-to-world matrix in the input's world of a camera in the run's."""
    rotation = camera.world_to_camera[:3, :3] @ similarity.rotation
    centre = similarity.rotation.T @ camera.centre * similarity.scale + similarity.origin
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.T @ np.diag([1.0, -1.0, -1.0]), centre
    return matrix


def write_reference(
    folder: Path,
    scene: Scene,
    views: Sequence[Camera],
    *,
    names: Sequence[str] | None = None,
    similarity: Similarity = WORLD,
    lens: dict[str, Any] | None = None,
    pictures: Sequence[NDArray[np.uint8]] | None = None,
) -> Path:
    """``images/`` and ``transforms.json`` of what the scene shows at ``views``."""
    (folder / "images").mkdir(parents=True)
    names = names or [f"{index:03d}" for index in range(len(views))]
    frames = []
    for index, (name, view) in enumerate(zip(names, views, strict=True)):
        write_rgb(folder / "images" / f"{name}.png", pictures[index] if pictures else picture(scene, view))
        frames.append(
            {"file_path": f"images/{name}.png", "transform_matrix": to_input(view, similarity).tolist()}
        )
    first = views[0]
    camera = {"w": first.width, "h": first.height, "fl_x": first.fx, "fl_y": first.fy}
    camera |= {"cx": first.cx, "cy": first.cy, **(lens or {})}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    return folder


def write_run(
    folder: Path,
    scene: Scene,
    views: Sequence[Camera],
    *,
    poses: Literal["given", "sfm"] = "given",
    test: Sequence[int] = (),
    masked: bool = False,
    names: Sequence[str] | None = None,
) -> Path:
    """A run as far as evaluation reads it: ingest, and the scene of g0."""
    ingest = folder / "ingest"
    (ingest / "images").mkdir(parents=True)
    rows = []
    for index, view in enumerate(views):
        image = f"images/{index:06d}.png"
        write_rgb(ingest / image, picture(scene, view))
        if masked:
            (ingest / "masks").mkdir(exist_ok=True)
            mask = np.full((view.height, view.width), 255, np.uint8)
            mask[:, : view.width // 2] = 0
            write_mask(ingest / "masks" / f"{index:06d}.png", mask)
        pose = Pose(view.world_to_camera[:3, :3], view.world_to_camera[:3, 3])
        rows.append(
            {
                "frame_id": index,
                "name": f"images/{names[index] if names else f'{index:03d}'}.jpg",
                "image": image,
                "time_s": None,
                **{key: getattr(view, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
                **dict(zip(("qw", "qx", "qy", "qz"), pose.quaternion, strict=True)),
                **dict(zip(("tx", "ty", "tz"), pose.translation.tolist(), strict=True)),
                "registered": True,
                "n_points": 0,
                "split": "test" if index in test else "train",
            }
        )
    write_table(ingest / "frames.parquet", pa.Table.from_pylist(rows, FRAMES), FRAMES)
    config = check_document(installed(), {})
    write_run_file(
        RunSpec(folder.absolute(), folder.absolute() / "capture", config, folder / ".store", "cpu")
    )
    WORLD.write(ingest)
    note_finished(folder, "ingest", {"poses": poses})
    (folder / "rva").mkdir()
    note_finished(folder, "rva")
    add_scene(folder, "g0", scene)
    return folder


def add_scene(folder: Path, stage: str, scene: Scene) -> None:
    """RUN/<stage> with a scene that was trained on the training frames."""
    (folder / stage).mkdir()
    write_ply(folder / stage / "scene.ply", scene)
    train = [frame.frame_id for frame in load_frames(folder / "ingest") if frame.split == "train"]
    write_exposure(folder / stage / "exposure.parquet", Exposure.identity(train))
    note_finished(folder, stage)


def note_finished(folder: Path, stage: str, summary: Mapping[str, Any] | None = None) -> None:
    """The manifest of RUN/<stage>: made with the run's settings from what lies before it."""
    run = read_run_file(folder, installed())
    made = {name: found for name in installed().names if (found := linked_manifest(folder, name)) is not None}
    planner = Planner(installed(), run, Store(run.store, DigestMemo(folder / "memo")), 1, SilentReporter())
    inputs, origins = planner.inputs(stage, made)
    parts = KeyParts(
        stage=stage,
        version=1,
        config=key_config(run.config.sections[stage]),
        inputs=inputs,
        externals={},
        seed=0,
        device="cpu",
        libraries={},
    )
    files = {
        name: FileRecord(size=file.stat().st_size, digest=file_digest(file))
        for name, file in published_files(folder / stage).items()
    }
    manifest = Manifest(
        stage=stage,
        key=parts.key,
        status="complete",
        missing=(),
        inherited=(),
        parts=parts,
        origins=origins,
        files=files,
        digest="",
        versions={},
        started="",
        seconds=0.0,
        device="cpu",
        summary=dict(summary or {}),
    )
    write_manifest(folder / stage, manifest)


def turned(camera: Camera, degrees: float) -> Camera:
    """The camera turned about its own axes."""
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.8, 0.0])).as_matrix()
    return replace(camera, world_to_camera=step @ camera.world_to_camera)
