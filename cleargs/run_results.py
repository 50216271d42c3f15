"""What lies in a run folder: finished stages, their tables, the scene; and a prepared capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cleargs.errors import InputError
from cleargs.manifest import Manifest, read_manifest
from cleargs.pipeline.dag import Dag, installed
from cleargs.pipeline.run_file import read_run_file

if TYPE_CHECKING:
    import pyarrow as pa

    from cleargs.capture.tables import Frame, Points
    from cleargs.splat.camera import Camera
    from cleargs.splat.scene import Scene
    from cleargs.splat.views import TrainingView


SCENE = "scene.ply"
"""What a stage that trains leaves."""


def scene_stage(dag: Dag, run: Path, chosen: str | None) -> str:
    """The stage whose scene to take: ``chosen``, or the last that has one.

    Raises InputError when there is no such scene.
    """
    done = [name for name in dag.names if (run / name / SCENE).is_file()]
    stage = done[-1] if done and chosen is None else chosen and dag.check(chosen)
    if stage in done:
        return stage
    place = f"{stage} has no scene in {run}" if stage else f"there is no scene in {run}"
    others = f"; the stages with a scene are {', '.join(done)}" if done else ""
    raise InputError(place, hint=f"see cleargs status {run}{others}")


def open_run(folder: str | Path) -> Run:
    """The run in ``folder``. Raises InputError when there is none."""
    return Run(read_run_file(Path(folder), installed()).folder)


@dataclass(frozen=True)
class Run:
    """A run folder: ``run["rva"]`` is a finished stage."""

    folder: Path

    @property
    def stages(self) -> tuple[str, ...]:
        """The finished stages, in order."""
        return tuple(name for name in installed().names if (self.folder / name).is_dir())

    def __getitem__(self, stage: str) -> StageResults:
        """The results of a stage. Raises InputError where it is not finished."""
        installed().check(stage)
        try:
            return StageResults(self.folder / stage, read_manifest(self.folder / stage))
        except (OSError, ValueError) as error:
            raise InputError(
                f"{stage} is not finished in {self.folder}", hint=f"see cleargs status {self.folder}"
            ) from error

    def scene(self, stage: str | None = None) -> Scene:
        """The scene of ``stage``, or of the last that has one. Raises InputError where there is none."""
        from cleargs.splat.ply import read_ply

        return read_ply(self.scene_file(stage))

    def scene_file(self, stage: str | None = None) -> Path:
        """The file of `scene`."""
        return self.folder / scene_stage(installed(), self.folder, stage) / SCENE


@dataclass(frozen=True)
class StageResults:
    """What a finished stage left in ``folder``, and the manifest that says from what."""

    folder: Path
    manifest: Manifest

    @property
    def summary(self) -> dict[str, Any]:
        """The figures that the stage reports."""
        return self.manifest.summary

    def table(self, name: str) -> pa.Table:
        """The table ``name`` (``frames``, say), all its columns. Raises InputError where there is none,
        StoreError where it is damaged.
        """
        from cleargs.parquet import read_any_table

        path = self.folder.resolve() / f"{name}.parquet"
        if not path.is_file():
            known = sorted(Path(file).stem for file in self.manifest.files if file.endswith(".parquet"))
            raise InputError(
                f"{self.manifest.stage} has no table {name!r}", hint=f"its tables are {', '.join(known)}"
            )
        return read_any_table(path)

    def weights(self) -> dict[int, float]:
        """Frame -> weight of its supervision in [0, 1]: of ``rva``."""
        table = self.table("frames")
        return dict(zip(table["frame_id"].to_pylist(), table["weight"].to_pylist(), strict=True))


def open_prepared(folder: StageResults | str | Path) -> Prepared:
    """The frames, cameras and points of a finished ``ingest`` (``run["ingest"]``, or its folder)."""
    from cleargs.capture.tables import load_frames, load_points

    place = folder.folder if isinstance(folder, StageResults) else Path(folder)
    return Prepared(place, load_frames(place), load_points(place))


@dataclass(frozen=True, eq=False)
class Prepared:
    """A capture with poses, in the normalised world: the farthest camera is at distance 1 of the origin."""

    folder: Path
    frames: list[Frame]
    """All of them, by frame_id; those without a pose too."""
    points: Points

    def views(self, weights: Mapping[int, float] | None = None) -> list[TrainingView]:
        """What a training looks at: the frames with a pose, not held out, whose weight (default: 1) is
        above 0. Images are read when they are needed.
        """
        from cleargs.formation.frames import real_views

        given = {frame.frame_id: 1.0 for frame in self.frames} if weights is None else weights
        return real_views(self.frames, given, self.folder)

    def cameras(self) -> dict[int, Camera]:
        """Frame -> camera, of every frame with a pose, held-out ones too."""
        from cleargs.formation.frames import view_of

        posed = (frame for frame in self.frames if frame.registered)
        return {frame.frame_id: view_of(frame, self.folder, 1.0).camera for frame in posed}
