"""The files of a trained scene, which no other module reads or writes by name.

| file | content |
|---|---|
| ``scene.ply`` | the Gaussians |
| ``exposure.parquet`` | one colour affine per frame |
| ``formation.parquet`` | image formation and weight of each frame |
| ``movement.parquet`` | regions of frames in which something moves |
| ``state.safetensors`` | Adam's moments, from which the next training continues |
| ``train.parquet`` | log with one row per step |
| ``rejected.ply`` | a later scene that did harm |
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cleargs.files import atomic_path

if TYPE_CHECKING:
    import pyarrow as pa

    from cleargs.formation.capture import CaptureFormation
    from cleargs.formation.exposure import Exposure
    from cleargs.formation.frame import FrameFormation
    from cleargs.splat.gaussians import Gaussians
    from cleargs.splat.scene import Scene
    from cleargs.splat.training import Trained
    from cleargs.splat.types import Moments
    from cleargs.types import MaskBool

SCENE, STATE, LOG, REJECTED = "scene.ply", "state.safetensors", "train.parquet", "rejected.ply"
EXPOSURE, FORMATION, MOVEMENT = "exposure.parquet", "formation.parquet", "movement.parquet"

TRAINED = (SCENE, EXPOSURE, FORMATION, MOVEMENT, STATE)
"""Files from which the next training continues."""


@dataclass(frozen=True)
class SceneFolder:
    """The folder of a trained scene. A missing or damaged file is a StoreError when it is read."""

    path: Path

    @property
    def finished(self) -> bool:
        """True if a training has written all its files."""
        return (self.path / SCENE).exists()

    def scene(self) -> Scene:
        """Read the scene."""
        from cleargs.splat.ply import read_ply

        return read_ply(self.path / SCENE)

    def exposure(self) -> Exposure:
        """Read the affines of the frames; all are the identity if exposure compensation is off."""
        from cleargs.formation.exposure import read_exposure

        return read_exposure(self.path / EXPOSURE)

    def formations(self) -> tuple[dict[int, FrameFormation], dict[int, float]]:
        """Read formation and last weight of each frame, by frame_id."""
        from cleargs.formation.table import read_formation

        return read_formation(self.path / FORMATION)

    def formation_rows(self) -> dict[int, dict[str, Any]]:
        """Read the columns of the formation of each frame, by frame_id; empty without the table."""
        from cleargs.parquet import read_any_table

        path = self.path / FORMATION
        rows = read_any_table(path).to_pylist() if path.is_file() else []
        return {row.pop("frame_id"): row for row in rows}

    def moving(self) -> dict[int, MaskBool]:
        """Read the cells that move [rows, columns], by frame_id; empty for a scene of an older version."""
        from cleargs.formation.movement import read_movement

        path = self.path / MOVEMENT
        return read_movement(path) if path.is_file() else {}

    def moments(self, gaussians: Gaussians) -> Moments:
        """Read the moments of Adam of the scene's ``gaussians``."""
        from cleargs.splat.state import read_moments

        return read_moments(self.path / STATE, gaussians)

    def log(self) -> pa.Table | None:
        """Read the log of the steps; None without one."""
        from cleargs.parquet import read_table
        from cleargs.splat.tables import TRAIN

        path = self.path / LOG
        return read_table(path, TRAIN) if path.is_file() else None

    def write(
        self,
        trained: Trained,
        exposure: Exposure,
        formation: CaptureFormation,
        weights: Mapping[int, float],  # RVA's, by frame_id
    ) -> None:
        """Write all files of a training, the scene last: it marks the training as done."""
        from cleargs.formation.exposure import write_exposure
        from cleargs.formation.movement import write_movement
        from cleargs.formation.table import write_formation
        from cleargs.parquet import write_table
        from cleargs.splat.ply import write_ply
        from cleargs.splat.state import save_state
        from cleargs.splat.tables import TRAIN

        write_table(self.path / LOG, trained.rows, TRAIN)
        save_state(self.path / STATE, trained.state)
        write_exposure(self.path / EXPOSURE, exposure)
        write_formation(self.path / FORMATION, formation, weights)
        write_movement(self.path / MOVEMENT, formation.moving)
        write_ply(self.path / SCENE, trained.scene)

    def publish(self, trainings: Sequence[SceneFolder], out: Path, rejected: SceneFolder | None) -> None:
        """Copy the scene, byte for byte, into the stage folder ``out``, with the logs of all ``trainings``.

        The scene of ``rejected`` is stored next to it.
        """
        import pyarrow as pa

        from cleargs.parquet import write_table
        from cleargs.splat.tables import TRAIN

        logs = [log for training in trainings if (log := training.log()) is not None]
        write_table(out / LOG, pa.concat_tables([TRAIN.empty_table(), *logs]), TRAIN)
        for name in (EXPOSURE, FORMATION, MOVEMENT, STATE, SCENE):
            _copy(self.path / name, out / name)
        if rejected is not None:
            _copy(rejected.path / SCENE, out / REJECTED)

    def drop_state(self) -> None:
        """Remove the state of a finished training (three scenes large). Only the last one is needed."""
        (self.path / STATE).unlink(missing_ok=True)


def _copy(source: Path, target: Path) -> None:
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)
