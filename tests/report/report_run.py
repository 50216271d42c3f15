"""A hand-made finished run: seven frames of a wall of blobs, two scenes, names that try to break pages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch

from cleargs.capture.cameras import Similarity
from cleargs.capture.tables import FRAMES
from cleargs.digest import file_digest, tree_digest
from cleargs.formation.exposure import Exposure, write_exposure
from cleargs.manifest import FileRecord, KeyParts, Manifest, linked_manifest, published_files, write_manifest
from cleargs.media.exr import LayeredImage, to_layer, write_exr
from cleargs.media.image import write_rgb
from cleargs.parquet import write_table
from cleargs.pipeline.config import load_config
from cleargs.pipeline.keys import key_config
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import RunSpec, write_run_file
from cleargs.pipeline.stages import installed
from cleargs.pipeline.store import Store
from cleargs.progress import SilentReporter
from cleargs.rivr.tables import Selection, latest_accepted, write_repairs, write_selection
from cleargs.rva.tables import FRAMES as RVA_FRAMES
from cleargs.rva.tables import R_CUES
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.ply import write_ply
from cleargs.splat.render import Viewer
from cleargs.splat.scene import Scene
from cleargs.splat.tables import TRAIN

WIDTH, HEIGHT, FOCAL = 96, 54, 90.0
COUNT = 7
UNPLACED = 6
HOSTILE = ("</script><script>window.hacked = 1</script>.jpg", '"><img src=x onerror="window.hacked = 2">.jpg')
ROLES = ("strong", "geometric", "auxiliary", "strong", "reactivated", "suppressed", "suppressed")
WEIGHTS = (0.9, 0.6, 0.4, 0.99, 0.1, 0.0, 0.0)


def wall(seed: int, gaussians: int = 4000, sh_degree: int = 1) -> Scene:
    """Opaque coloured blobs at depth 2, wider than the view of any camera.

    They are small, since renderers draw large blobs at similar depths in different orders.
    """
    chance = np.random.default_rng(seed)

    def tensor(values: Any) -> torch.Tensor:
        return torch.from_numpy(np.asarray(values, np.float32))

    means = chance.uniform([-2.2, -1.4, 1.9], [2.2, 1.4, 2.1], (gaussians, 3))
    sh = np.zeros((gaussians, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = chance.uniform(-1.6, 1.6, (gaussians, 3))
    sh[:, 1:] = chance.normal(0, 0.08, sh[:, 1:].shape)
    return Scene(
        Gaussians(
            means=tensor(means),
            log_scales=tensor(np.log(chance.uniform(0.02, 0.07, (gaussians, 3)))),
            rotations=tensor(chance.normal(size=(gaussians, 4))),
            logit_opacities=tensor(chance.uniform(1.0, 4.0, gaussians)),
            sh=tensor(sh),
        )
    )


def camera(index: int, height: float = HEIGHT, width: float = WIDTH) -> Camera:
    """One of several cameras side by side, rotated a little towards the middle."""
    angle = 0.05 * (index - 3)
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = -pose[:3, :3] @ [0.2 * (index - 3), 0.03 * index, 0.0]
    return Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)


class FinishedRun:
    """A run folder as `cleargs run` writes it, with all five stages done."""

    def __init__(self, root: Path, name: str = "run", held_out: Sequence[int] = ()) -> None:
        self.folder = root / name
        self.dag = installed()
        self.scenes = {"g0": wall(1), "consolidate": wall(2)}
        self.held_out = held_out
        overrides = ["rva.tau_R=0.61", *(["ingest.holdout=every:3"] if held_out else [])]
        config = load_config(self.dag, "smoke", overrides)
        self.run = RunSpec(self.folder, root / "gone & <away>.mp4", config, self.folder / ".store", "cpu")
        write_run_file(self.run)
        self._ingest()
        self._rva()
        g0 = {"psnr_strong": 25.0, "gaussians": 1500, "steps": 400, "exposure": True, "exposure_spread": 0.1}
        self._trained("g0", g0)
        self._rivr()
        held = {"frames": [0], "harm": None, "psnr_before": 24.0, "psnr_after": 25.5}
        consolidated = {"repairs": 5, "published": "consolidated scene", "control": held}
        self._trained("consolidate", consolidated | {"psnr_unseen": 24.6})

    def planner(self, store: Store) -> Planner:
        """A planner of this run with one thread."""
        return Planner(self.dag, self.run, store, 1, SilentReporter())

    def finish(self, stage: str, summary: dict[str, Any]) -> None:
        """Write the manifest of a stage, from the files in its folder."""
        folder = self.folder / stage
        files = {
            name: FileRecord(size=file.stat().st_size, digest=file_digest(file))
            for name, file in published_files(folder).items()
        }
        libraries = {"numpy": np.__version__}
        ingest = linked_manifest(self.folder, "ingest") if stage != "ingest" else None
        parts = KeyParts(
            stage=stage,
            version=1,
            config=key_config(self.run.config.sections[stage]),
            inputs={} if ingest is None else {"ingest": {"images": tree_digest(ingest.under("images"))}},
            externals={},
            seed=0,
            device="cpu",
            libraries=libraries,
        )
        manifest = Manifest(
            stage=stage,
            key=parts.key,
            status="complete",
            missing=(),
            inherited=(),
            parts=parts,
            origins={},
            files=files,
            digest="",
            versions={"cleargs": "0.1.0"},
            started="2026-01-02T03:04:05+00:00",
            seconds=12.0,
            device="cpu",
            summary=summary,
        )
        write_manifest(folder, manifest)

    def _ingest(self) -> None:
        folder = self.folder / "ingest"
        (folder / "images").mkdir(parents=True)
        render = Viewer(self.scenes["g0"]).view
        rows = []
        for index in range(COUNT):
            pose = camera(index)
            write_rgb(folder / f"images/{index:06d}.png", render(pose))
            angle = 0.05 * (index - 3)
            t = pose.world_to_camera[:3, 3]
            placed = index != UNPLACED
            q = (np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0)
            values = {"qw": q[0], "qx": q[1], "qy": q[2], "qz": q[3], "tx": t[0], "ty": t[1], "tz": t[2]}
            rows.append(
                {
                    "frame_id": index,
                    "name": HOSTILE[index] if index < len(HOSTILE) else f"clip.mp4#{index}",
                    "image": f"images/{index:06d}.png",
                    "time_s": index / 30,
                    "width": WIDTH,
                    "height": HEIGHT,
                    "fx": FOCAL,
                    "fy": FOCAL,
                    "cx": WIDTH / 2,
                    "cy": HEIGHT / 2,
                    **{name: float(value) if placed else None for name, value in values.items()},
                    "registered": placed,
                    "n_points": 30,
                    "split": "test" if index in self.held_out else "train",
                }
            )
        write_table(folder / "frames.parquet", pa.Table.from_pylist(rows, FRAMES), FRAMES)
        turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        Similarity(turn.T, np.array([1.0, -2.0, 3.0]), 2.5).write(folder)
        self.finish("ingest", {"frames": COUNT, "frames_available": COUNT, "registered": 6})

    def _rva(self) -> None:
        (self.folder / "rva").mkdir()
        rows = []
        for index in range(COUNT):
            row: dict[str, Any] = dict.fromkeys(RVA_FRAMES.names)
            row |= {name: 0.2 for name in RVA_FRAMES.names if name.startswith(("r_", "b_"))}
            row |= {f"r_{name}": 0.9 for name in R_CUES}
            row |= {"frame_id": index, "name": "", "evaluator": "test-1", "R": 0.8, "B": 0.1, "G": 0.3}
            row |= {"role": ROLES[index], "weight": WEIGHTS[index], "b_motion_blur": 0.7, "reliable": True}
            row |= {"fallback": False}
            rows.append(row)
        write_table(self.folder / "rva/frames.parquet", pa.Table.from_pylist(rows, RVA_FRAMES), RVA_FRAMES)
        self.finish("rva", {"effective_frames": 2.7, "bins_uncovered_before": 1, "fallback": 0})

    def _trained(self, stage: str, summary: dict[str, Any]) -> None:
        folder = self.folder / stage
        folder.mkdir()
        write_ply(folder / "scene.ply", self.scenes[stage])
        chance = np.random.default_rng(0)
        rows = [
            {
                "round": 0,
                "step": step + 1,
                "frame_id": step % 5,
                "kind": "real" if step % 3 else "pseudo",
                "weight": 1.0,
                "width": WIDTH,
                "height": HEIGHT,
                "loss": 0.1 / (1 + step) + 0.01 * chance.random(),
                "l1": 0.1,
                "ssim": 0.9,
                "psnr": 20.0 + 0.05 * step,
                "n_gaussians": 1000 + 5 * step,
                "sh_degree": 1,
            }
            for step in range(90)
        ]
        write_table(folder / "train.parquet", pa.Table.from_pylist(rows, TRAIN), TRAIN)
        trained_on = [frame for frame in range(5) if frame not in self.held_out]
        gains = np.linspace(0.8, 1.2, len(trained_on))[:, None].repeat(3, axis=1)
        write_exposure(folder / "exposure.parquet", Exposure.from_gains(trained_on, gains))
        if stage == "consolidate":
            write_repairs(folder / "repairs.parquet", latest_accepted(self.selections))
        self.finish(stage, summary)

    def _rivr(self) -> None:
        folder = self.folder / "rivr"
        (folder / "round_01").mkdir(parents=True)
        render = Viewer(self.scenes["consolidate"]).view
        rows = []
        for index in range(5):
            image = render(camera(index)).astype(np.float32) / 255
            names = ("observed", "render", "restored")
            layers = {
                name: to_layer(image * shade) for name, shade in zip(names, (1.0, 0.9, 0.8), strict=True)
            }
            exr = f"round_01/{index:06d}.exr"
            write_exr(folder / exr, LayeredImage(layers, {}))
            rows.append(
                Selection(
                    round=1,
                    frame_id=index,
                    exr=exr,
                    primary_metric="sharp-1",
                    primary={"render": 80.0, "restored": 85.0 + index, "observed": 75.0},
                    tiebreak_metric="natural-1",
                    tiebreak={"render": 70.0, "restored": 71.0, "observed": 72.0},
                    restored_from="observed",
                    blur_px=2.0 * index,
                    skew_px=0.3,
                    chosen="restored",
                    accepted=index != 4,
                    reason="primary score" if index != 4 else "refused: too far from the frame",
                )
            )
        write_selection(folder / "selection.parquet", rows)
        self.selections = rows
        self.finish("rivr", {"published": "G0", "rounds": []})
