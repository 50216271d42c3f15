"""The stage ``g0`` on a tiny capture: from the tables of ingest and RVA to a scene."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pytest
from helpers.splat_toy import HEIGHT, WIDTH, angles, camera, gaussians, images
from pydantic import ValidationError

from cleargs.capture.tables import FRAMES, OBSERVATIONS, POINTS
from cleargs.errors import InputError
from cleargs.formation.exposure import read_exposure
from cleargs.parquet import read_table, write_table
from cleargs.pipeline.stage import StageContext
from cleargs.progress import CountedTask, SilentReporter, Task
from cleargs.rva.tables import FRAMES as RVA_FRAMES
from cleargs.scene.config import G0Config
from cleargs.splat.constants import SH_C0
from cleargs.splat.ply import read_ply
from cleargs.splat.tables import TRAIN
from cleargs.splat.trainer import Trainer
from cleargs.stages import cost, g0
from cleargs.stages.config import DistilConfig

ACTIVE = {0: 0.9, 1: 0.97, 2: 1.0, 5: 0.12}
SUPPRESSED, HELD_OUT, UNREGISTERED = 3, 4, 6
CONFIG = G0Config(
    steps=60,
    refine_every=5 / 60,
    min_points=100,
    budget=120,
    checkpoint_interval=20,
    lr_means=2e-3,
    sh_every=20 / 60,
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders ingest/ and rva/ of seven frames; only active frames have a valid image."""
    root = tmp_path_factory.mktemp("capture")
    truth = gaussians()
    pictures = images(truth, 7)
    (root / "ingest" / "images").mkdir(parents=True)
    (root / "rva").mkdir()
    rows, rated = [], []
    for frame_id, angle in enumerate(angles(7)):
        image = f"images/{frame_id:06d}.png"
        data = cv2.imencode(".png", pictures[frame_id][..., ::-1])[1].tobytes() if frame_id in ACTIVE else b""
        (root / "ingest" / image).write_bytes(data)
        eye, registered = camera(angle), frame_id != UNREGISTERED
        pose = (np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0, *eye.world_to_camera[:3, 3])
        rows.append(
            {
                "frame_id": frame_id,
                "name": image,
                "image": image,
                "time_s": None,
                "width": WIDTH,
                "height": HEIGHT,
            }
            | {name: getattr(eye, name) for name in ("fx", "fy", "cx", "cy")}
            | dict(
                zip(
                    ("qw", "qx", "qy", "qz", "tx", "ty", "tz"),
                    pose if registered else [None] * 7,
                    strict=True,
                )
            )
            | {"registered": registered, "n_points": 60, "split": "test" if frame_id == HELD_OUT else "train"}
        )
        if frame_id != HELD_OUT:
            rated.append(
                dict.fromkeys(RVA_FRAMES.names, 0.5)
                | {"frame_id": frame_id, "name": image, "evaluator": "toy-1", "bin": 0}
                | {"reliable": frame_id in ACTIVE, "fallback": False, "reactivated_for": None}
                | {"weight": ACTIVE.get(frame_id, 0.0), "b_ghosting": 0.0}
                | {"role": "strong" if ACTIVE.get(frame_id, 0.0) > 0.8 else "suppressed"}
            )
    write_table(root / "ingest" / "frames.parquet", pa.Table.from_pylist(rows, FRAMES), FRAMES)
    write_table(root / "rva" / "frames.parquet", pa.Table.from_pylist(rated, RVA_FRAMES), RVA_FRAMES)
    xyz = truth.means.numpy().astype(np.float64)
    colour = np.rint(np.clip(truth.sh[:, 0].numpy() * SH_C0 + 0.5, 0, 1) * 255).astype(np.uint8)
    ids = np.arange(60)[::-1] * 10  # not sorted, with gaps
    points = dict(zip(("x", "y", "z", "r", "g", "b"), [*xyz.T, *colour.T], strict=True))
    points |= {"point_id": ids, "error": np.full(60, 0.3), "track_length": np.full(60, 4, np.int32)}
    write_table(root / "ingest" / "points.parquet", pa.table(points), POINTS)
    seen = {"frame_id": np.repeat(np.arange(5, dtype=np.int32), 60), "point_id": np.tile(ids, 5)}
    write_table(root / "ingest" / "observations.parquet", pa.table(seen), OBSERVATIONS)
    return root


def context(capture: Path, work: Path, config: G0Config = CONFIG, threads: int = 1) -> StageContext[G0Config]:
    for folder in (work / "out", work / "checkpoints"):
        folder.mkdir(parents=True, exist_ok=True)
    return StageContext(
        config=config,
        source=capture,
        inputs={"ingest": capture / "ingest", "rva": capture / "rva"},
        externals={},
        out=work / "out",
        checkpoints=work / "checkpoints",
        cache=work / "kept",
        seed=3,
        device="cpu",
        threads=threads,
        reporter=SilentReporter(),
    )


def digests(work: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in (work / "out").iterdir()}


def test_only_active_frames_train_the_scene(capture: Path, tmp_path: Path) -> None:
    result = g0.run(context(capture, tmp_path))
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(g0.OUTPUTS)
    rows = read_table(tmp_path / "out" / "train.parquet", TRAIN).to_pylist()
    first = {row["frame_id"]: row["weight"] for row in reversed(rows)}  # later they may earn more
    assert first == pytest.approx(ACTIVE)
    scene = read_ply(tmp_path / "out" / "scene.ply")
    summary = dict(result.summary)
    assert summary["gaussians"] == scene.gaussians.num == 120
    assert (summary["gaussians_start"], summary["views"], summary["sh_degree"]) == (100, 4, 0)
    # Initial colours and positions are correct, so a short training fits the strong frames well. An empty or
    # mirrored scene stays below 15 dB.
    assert summary["psnr_strong"] > 18.0
    assert not summary["exposure"]
    exposure = read_exposure(tmp_path / "out" / "exposure.parquet")
    assert exposure.frame_ids.tolist() == sorted(ACTIVE)
    assert not exposure.enabled
    assert g0.estimate(context(capture, tmp_path)).disk_gb == pytest.approx(0.7e-6 * 120)


def test_later_trainings_are_estimated_from_the_scene_that_g0_reaches(capture: Path, tmp_path: Path) -> None:
    """The maximum number of Gaussians is not reached. It would make them ten times as expensive."""
    config = CONFIG.model_copy(update={"budget": 100_000})
    ready = replace(context(capture, tmp_path, config), settings={"g0": config})
    first, later = cost.first_training(ready, config), cost.distillation(ready, DistilConfig())
    assert 100 < first.gaussians < 1000 and later.gaussians == first.gaussians


def test_threads_and_a_kill_change_no_byte(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    g0.run(context(capture, tmp_path / "one"))
    g0.run(context(capture, tmp_path / "two", threads=2))
    expected = digests(tmp_path / "one")
    assert digests(tmp_path / "two") == expected
    step = Trainer.step

    def die(trainer: Trainer) -> None:
        if trainer.done == 45:
            raise KeyboardInterrupt
        step(trainer)

    monkeypatch.setattr(Trainer, "step", die)
    with pytest.raises(KeyboardInterrupt):
        g0.run(context(capture, tmp_path / "cut"))
    monkeypatch.undo()
    assert not any((tmp_path / "cut" / "out").iterdir())
    g0.run(context(capture, tmp_path / "cut"))
    assert digests(tmp_path / "cut") == expected


def test_exposure_can_be_forced(capture: Path, tmp_path: Path) -> None:
    result = g0.run(context(capture, tmp_path, CONFIG.model_copy(update={"exposure": "on"})))
    assert result.summary["exposure"]
    assert read_exposure(tmp_path / "out" / "exposure.parquet").enabled


def test_exposure_spread_is_reported_without_compensation(capture: Path, tmp_path: Path) -> None:
    off = g0.run(context(capture, tmp_path / "off", CONFIG.model_copy(update={"exposure": "off"})))
    on = g0.run(context(capture, tmp_path / "on", CONFIG.model_copy(update={"exposure": "on"})))
    assert off.summary["exposure_spread"] == on.summary["exposure_spread"] is not None


@pytest.mark.parametrize("background", [(255, 255, 255), (-0.1, 0, 0), (float("nan"), 0, 0)])
def test_a_background_is_a_colour(background: tuple[float, ...]) -> None:
    with pytest.raises(ValidationError):
        G0Config(background=background)


def test_no_active_frame_is_an_error(capture: Path, tmp_path: Path) -> None:
    table: Any = read_table(capture / "rva" / "frames.parquet", RVA_FRAMES)
    index = table.schema.get_field_index("weight")
    nothing = table.set_column(index, RVA_FRAMES.field("weight"), pa.array(np.zeros(len(table))))
    (tmp_path / "rva").mkdir()
    write_table(tmp_path / "rva" / "frames.parquet", nothing, RVA_FRAMES)
    (tmp_path / "ingest").symlink_to(capture / "ingest")
    with pytest.raises(InputError, match="weight"):
        g0.run(context(tmp_path, tmp_path / "work"))


@pytest.mark.parametrize("budget", [1, 30, 80])
def test_the_budget_is_a_maximum_from_the_first_step(capture: Path, tmp_path: Path, budget: int) -> None:
    """Budgets below the number of sparse points (60), and between it and min_points (100)."""
    config = CONFIG.model_copy(update={"budget": budget, "steps": 3})
    result = g0.run(context(capture, tmp_path, config))
    summary = dict(result.summary)
    assert summary["gaussians_start"] == budget
    assert summary["gaussians"] == read_ply(tmp_path / "out" / "scene.ply").gaussians.num == budget


def compiled() -> set[str]:
    """Return the kernels of this process, with the types for which they are compiled or loaded."""
    from numba.core.dispatcher import Dispatcher

    modules = [name for name in sys.modules if name.startswith("cleargs.splat.kernels.cpu.")]
    return {
        f"{name}.{kernel}{signature}"
        for name in modules
        for kernel, found in vars(sys.modules[name]).items()
        if isinstance(found, Dispatcher) and found.__module__ == name
        for signature in found.signatures
    }


class CompiledWithin(SilentReporter):
    """Reporter that finds kernels compiled while a task is open."""

    def __init__(self) -> None:
        self.before: set[str] = set()
        self.found: set[str] = set()

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        self.before = compiled()
        yield CountedTask(total, lambda *shown: None)
        self.found |= compiled() - self.before


def test_kernels_are_compiled_before_the_progress_bar(capture: Path, tmp_path: Path) -> None:
    """Run in a separate process, because other tests may have compiled kernels in this one."""
    program = (
        "import sys; from dataclasses import replace; from pathlib import Path\n"
        "from test_g0 import CompiledWithin, context, g0\n"
        "watch = CompiledWithin()\n"
        "g0.run(replace(context(Path(sys.argv[1]), Path(sys.argv[2])), reporter=watch))\n"
        "assert any('normal_equations' in kernel for kernel in watch.before)\n"
        "print(sorted(watch.found))\n"
    )
    command = [sys.executable, "-c", program, str(capture), str(tmp_path)]
    here = Path(__file__).parent
    environment = os.environ | {"PYTHONPATH": f"{here}{os.pathsep}{here.parent}"}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(
    ("asked", "ghosting", "expected"),
    [("auto", 0.25, False), ("auto", 0.35, True), ("on", 0.0, True), ("off", 1.0, False)],
)
def test_movement_is_looked_for_where_something_hides_the_scene(
    asked: str, ghosting: float, expected: bool
) -> None:
    config = G0Config.model_validate({"formation": {"movement": asked}})
    cues = [{"b_ghosting": 0.0}, {"b_ghosting": ghosting}]
    assert g0.movement_expected(config, cues, [None, None]) is expected
    # With a detector, what it sees replaces the cue.
    assert g0.movement_expected(config, cues, [(), ()]) is (asked == "on")
    assert g0.movement_expected(config, cues, [(), ((0, 0, 9, 9),)]) is (asked != "off")
