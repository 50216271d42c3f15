"""A tiny capture with truth: a few Gaussians seen by eight cameras, some of the images blurred."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray

from cleargs.capture.tables import FRAMES
from cleargs.files import write_json
from cleargs.formation.capture import CaptureFormation
from cleargs.formation.exposure import Exposure, write_exposure
from cleargs.formation.movement import write_movement
from cleargs.formation.table import write_formation
from cleargs.media.image import write_mask, write_rgb
from cleargs.parquet import write_table
from cleargs.pipeline.stage import StageContext
from cleargs.progress import SilentReporter
from cleargs.rivr.tables import Selection, read_selection
from cleargs.rva.tables import FRAMES as RVA_FRAMES
from cleargs.scene.config import G0Config
from cleargs.splat.camera import Camera
from cleargs.splat.config import FormationConfig
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.ply import write_ply
from cleargs.splat.render import render
from cleargs.splat.scene import Scene
from cleargs.splat.state import save_state
from cleargs.splat.types import Moments
from cleargs.stages.consolidate import ConsolidateConfig
from cleargs.stages.rivr import RivrConfig

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
ROLES = ("strong", "suppressed", "geometric", "strong", "auxiliary", "strong", "reactivated", "suppressed")
WEIGHTS = (0.95, 0.0, 0.5, 0.95, 0.4, 0.95, 0.12, 0.0)
TEST_FRAME, UNREGISTERED_FRAME = 8, 9
"""Two more frames, which no part of RIVR may touch."""
MASKED_FRAME = 2

Image = NDArray[np.float32]


class Sharpen:
    """A restoration expert: unsharp masking. Counts its calls."""

    name = "sharpen"
    digest = "none"

    def __init__(self) -> None:
        self.calls = 0

    def restore(self, image: Image, *, threads: int = 1) -> Image:
        self.calls += 1
        soft = cv2.GaussianBlur(image, (0, 0), 1.5)
        return np.clip(image + 1.5 * (image - soft), 0.0, 1.0)


class Contrast:
    """A scorer: the mean gradient of the image, on a scale of about 100."""

    name = "contrast"
    digest = "none"

    def score(self, image: Image, *, threads: int = 1) -> float:
        dy, dx = np.gradient(image.astype(np.float64).mean(axis=2))
        return float(100.0 * np.hypot(dx, dy).mean() / 0.05)


class Darkness:
    """Another scorer, of another opinion."""

    name = "darkness"
    digest = "none"

    def score(self, image: Image, *, threads: int = 1) -> float:
        return float(100.0 - 100.0 * image.astype(np.float64).mean())


class Capture:
    """Finished folders of ingest, rva and g0 under one root, and stage contexts over them."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def use_good_scene(self) -> None:
        """Give G0 nearly the scene that the frames show: sharp enough to estimate how they were taken."""
        nearly = scene()
        nearly.sh += 0.02
        write_ply(self.root / "g0" / "scene.ply", Scene(nearly))

    def context(
        self, stage: str, config: Any, *, threads: int = 1, run: str = "run", **settings: Any
    ) -> StageContext[Any]:
        """A context whose outputs go to ``root/run/stage``; ``settings``: of the stages before."""
        out, checkpoints = self.root / run / stage, self.root / run / "work" / stage
        out.mkdir(parents=True, exist_ok=True)
        checkpoints.mkdir(parents=True, exist_ok=True)
        inputs: Mapping[str, Path] = {
            **{name: self.root / name for name in ("ingest", "rva", "g0")},
            "rivr": self.root / run / "rivr",
        }
        return StageContext(
            config=config,
            source=self.root,
            inputs=inputs,
            externals={},
            out=out,
            checkpoints=checkpoints,
            cache=checkpoints / "kept",
            seed=0,
            device="cpu",
            threads=threads,
            reporter=SilentReporter(),
            settings={"g0": tiny_g0(), "rivr": tiny_rivr(), **settings},
        )


def tiny_g0(**changes: Any) -> G0Config:
    """Checkpoints every five steps."""
    return G0Config(**({"checkpoint_interval": 5} | changes))


def tried_rows(context: StageContext[Any]) -> list[Selection]:
    """The rows of the frames that a finished RIVR tried."""
    return [row for row in read_selection(context.out / "selection.parquet") if row.exr is not None]


def tiny_rivr(**changes: Any) -> RivrConfig:
    """Return settings of two rounds of a few steps, within the margins of harm, with the paper's rules.

    Frames stay as they are, there are three candidates, and every target frame gets a pseudo observation.
    """
    settings: dict[str, Any] = {
        "rounds": 2,
        "targets": "all",
        "undo_motion": False,
        "candidates": ("fused",),
        "keep_raw": False,
        "distil": {"steps": 12},
        "harm": {"psnr_margin": 100, "score_margin": 100},
    }
    return RivrConfig(**(settings | changes))


def tiny_consolidate(**changes: Any) -> ConsolidateConfig:
    """A few steps."""
    return ConsolidateConfig(**({"distil": {"steps": 12}} | changes))


def write_capture(root: Path) -> None:
    """Ingest: images of the true scene, blurred where the role is low. G0: the true scene, disturbed."""
    truth = scene()
    rows = []
    for k in range(len(ROLES) + 2):
        registered = k != UNREGISTERED_FRAME
        camera = orbit(k)
        image = render(truth, camera).image.clamp(0, 1).numpy()
        if k < len(ROLES) and ROLES[k] != "strong":
            image = cv2.blur(image, (7, 1))
        write_rgb(prepared(root / "ingest" / "images") / f"{k:06d}.png", image)
        rows.append(frame_row(k, camera, registered))
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :20] = 0
    write_mask(prepared(root / "ingest" / "masks") / f"{MASKED_FRAME:06d}.png", mask)
    write_table(root / "ingest" / "frames.parquet", pa.Table.from_pylist(rows, FRAMES), FRAMES)
    assessments = [rva_row(k) for k in range(len(ROLES))]
    write_table(
        prepared(root / "rva") / "frames.parquet", pa.Table.from_pylist(assessments, RVA_FRAMES), RVA_FRAMES
    )
    g0 = prepared(root / "g0")
    noise = np.random.default_rng(1).normal(0, 0.2, truth.log_scales.shape)
    disturbed = truth.clone()
    disturbed.log_scales += torch.from_numpy(noise.astype(np.float32)) + 0.2
    write_ply(g0 / "scene.ply", Scene(disturbed))
    write_exposure(g0 / "exposure.parquet", Exposure.identity([0, 2, 3, 4, 5, 6]))
    write_formation(g0 / "formation.parquet", CaptureFormation([], FormationConfig()), {})
    write_movement(g0 / "movement.parquet", {})
    save_state(g0 / "state.safetensors", Moments.zeros(disturbed).state())
    write_json(g0 / "manifest.json", {})


def scene() -> Gaussians:
    """Sixty opaque blobs of all colours around the origin."""
    rng = np.random.default_rng(0)
    count = 60

    def tensor(values: NDArray[np.float64]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32))

    return Gaussians(
        means=tensor(rng.uniform(-0.5, 0.5, (count, 3))),
        log_scales=tensor(np.log(rng.uniform(0.03, 0.12, (count, 3)))),
        rotations=tensor(rng.normal(size=(count, 4))),
        logit_opacities=tensor(np.full(count, 2.0)),
        sh=tensor(rng.normal(0, 1.2, (count, 1, 3))),
    )


def orbit(k: int) -> Camera:
    """Camera k on an arc around the origin, at distance 1.2."""
    angle = np.deg2rad(8.0 * k)
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[2, 3] = 1.2
    return Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)


def frame_row(k: int, camera: Camera, registered: bool) -> dict[str, Any]:
    angle = np.deg2rad(8.0 * k)
    pose = dict.fromkeys(("qw", "qx", "qy", "qz", "tx", "ty", "tz"), 0.0)
    pose |= {"qw": np.cos(angle / 2), "qy": np.sin(angle / 2), "tz": 1.2}
    return {
        "frame_id": k,
        "name": f"{k}.png",
        "image": f"images/{k:06d}.png",
        "time_s": None,
        "width": WIDTH,
        "height": HEIGHT,
        "fx": FOCAL,
        "fy": FOCAL,
        "cx": WIDTH / 2,
        "cy": HEIGHT / 2,
        **{name: value if registered else None for name, value in pose.items()},
        "registered": registered,
        "n_points": 0,
        "split": "test" if k == TEST_FRAME else "train",
    }


def rva_row(k: int) -> dict[str, Any]:
    strong = ROLES[k] == "strong"
    known = {
        "frame_id": k,
        "name": f"{k}.png",
        "evaluator": "test",
        "R": 0.9 if strong else 0.2 + 0.01 * k,
        "B": 0.1 if strong else 0.8,
        "reliable": strong,
        "bin": 0,
        "role": ROLES[k],
        "weight": WEIGHTS[k],
        "fallback": False,
        "reactivated_for": None,
    }
    return {name: known.get(name, 0.0) for name in RVA_FRAMES.names}


def prepared(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
