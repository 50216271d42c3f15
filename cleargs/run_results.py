"""Results of a run folder: finished stages, their tables and scenes, and the prepared capture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cleargs.errors import InputError, StoreError
from cleargs.manifest import Manifest, has_results, linked_manifest
from cleargs.own_files import refuse_links
from cleargs.packed import read_pack, require_images
from cleargs.pipeline.run_file import SCENE as SCENE
from cleargs.pipeline.run_file import read_metadata, read_run_file, require_store
from cleargs.pipeline.stages import Stages, installed

if TYPE_CHECKING:
    import pyarrow as pa

    from cleargs.capture.tables import Frame, Points
    from cleargs.scene.viewer import Deblurred
    from cleargs.splat.camera import Camera
    from cleargs.splat.scene import Scene
    from cleargs.splat.views import TrainingView, ViewDataset


def scene_stage(dag: Stages, run: Path, chosen: str | None) -> str:
    """Return the stage ``chosen``, or the last stage that has a scene. Raise InputError if there is none."""
    if run.is_file():
        raise InputError("--stage chooses among the scenes of a run", hint="leave it out for a file")
    check_results(dag, run)
    done = [name for name in dag.names if scene_path(run, name).is_file() and has_results(run, name)]
    stage = done[-1] if done and chosen is None else chosen and dag.check(chosen)
    if stage in done:
        return stage
    require_store(run, read_metadata(run))
    message = f"{stage} has no scene in {run}" if stage else f"there is no scene in {run}"
    others = f"; the stages with a scene are {', '.join(done)}" if done else ""
    raise InputError(message, hint=f"see cleargs status {run}{others}")


def scene_origin(dag: Stages, run: Path, stage: str) -> str:
    """Return the stage that made the scene of ``stage``: a draft hands that of g0 on."""
    earlier, worked = dag.names[: dag.names.index(stage) + 1], read_run_file(run, dag).stages(dag)
    return next((name for name in reversed(earlier) if name in worked), stage)


def check_results(dag: Stages, run: Path) -> None:
    """Raise StoreError if results in ``run`` are behind a link that the store did not make, or have one."""
    if read_pack(run) is not None:
        refuse_links([run / SCENE])
    for stage in dag.names:
        if (run / stage).exists() and not has_results(run, stage):
            raise StoreError(
                f"{run / stage} is a link that leads elsewhere, or a link or a device is in it",
                hint=f"remove it, then see cleargs status {run}",
            )


def scene_path(run: Path, stage: str) -> Path:
    """Return the path of the scene of a stage, which need not exist. A packed run has its one at the top."""
    packed = read_pack(run)
    return run / SCENE if packed is not None and packed.scene == stage else run / stage / SCENE


def edited_scene(run: Path, stage: str, file: Path) -> Scene:
    """Read an edited copy of the scene of ``stage``, and give it the scene's anti-aliasing and background.

    Raises InputError if most of its Gaussians are at other places than those of the scene, and StoreError if
    a file cannot be read.
    """
    import numpy as np
    from scipy.spatial import KDTree

    from cleargs.splat.formats import read_scene
    from cleargs.splat.ply import read_ply

    own, edited = read_ply(scene_path(run, stage)), read_scene(file)
    places, own_places = edited.gaussians.means.numpy(), own.gaussians.means.numpy()
    if not len(places) or not len(own_places):
        raise InputError(f"{file} or the scene of {stage} has no Gaussians", hint="choose another file")
    reach = float(np.ptp(np.percentile(own_places, [1, 99], axis=0), axis=0).max())
    some = places[:: -(-len(places) // _COMPARED)]
    share = float((KDTree(own_places).query(some)[0] <= _SAME_PLACE * reach).mean())
    if share < 0.5:
        raise InputError(
            f"{file} is not where the scene of {run} is: {share:.0%} of its Gaussians are at a place of it",
            hint=f"edit the file of `cleargs export {run} -o edit.ply`, and keep its axes and size",
        )
    return replace(edited, antialias=own.antialias, background=own.background)


_COMPARED = 10_000  # Gaussians, at most
_SAME_PLACE = 1e-3  # share of the size of the scene; .compressed.ply moves Gaussians by less


def open_run(folder: str | Path) -> Run:
    """Open the run in ``folder``.

    Raises:
        InputError: if ``folder`` is not a run.

    Example:
        run = cg.open_run("run")
        print(run.stages, run.scene().gaussians.num)
    """
    return Run(read_run_file(Path(folder), installed()).folder)


@dataclass(frozen=True)
class Run:
    """A run folder. ``run["rva"]`` gives the results of a finished stage."""

    folder: Path

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the finished stages, in order."""
        return tuple(name for name in installed().names if has_results(self.folder, name))

    def _repr_html_(self) -> str:
        rows = [("stage", "state", "seconds", "MB")]
        for name, made in ((name, self[name].manifest) for name in self.stages):
            rows.append((name, made.status, f"{made.seconds:.1f}", f"{made.bytes / 1e6:.1f}"))
        body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
        return f"<p>{escape(str(self.folder))}</p><table>{body}</table>"

    def __getitem__(self, stage: str) -> StageResults:
        """Return the results of a stage. Raises InputError if it is not finished."""
        installed().check(stage)
        manifest = linked_manifest(self.folder, stage)
        if manifest is None:
            raise InputError(
                f"{stage} is not finished in {self.folder}", hint=f"see cleargs status {self.folder}"
            )
        return StageResults(self.folder / stage, manifest)

    def scene(self, stage: str | None = None) -> Scene:
        """Read the scene of ``stage``, or of the last stage that has one. Raises InputError without one."""
        from cleargs.splat.ply import read_ply

        return read_ply(self.scene_file(stage))

    def scene_file(self, stage: str | None = None) -> Path:
        """Return the path of the file that `scene` reads. Raises InputError without one."""
        return scene_path(self.folder, scene_stage(installed(), self.folder, stage))


@dataclass(frozen=True)
class StageResults:
    """Results of a finished stage, and the manifest that records their origin."""

    folder: Path
    manifest: Manifest

    def __repr__(self) -> str:
        return f"<results of {self.manifest.stage} in {self.folder}: {', '.join(self.manifest.summary)}>"

    @property
    def summary(self) -> dict[str, Any]:
        """Figures that the stage reports."""
        return self.manifest.summary

    def table(self, name: str) -> pa.Table:
        """Read the table ``name``, for example ``frames``, with all its columns.

        Raises:
            InputError: if the stage has no such table.
            StoreError: if the table is damaged.

        Example:
            table = cg.open_run("run")["rva"].table("frames")
            print(table.select(["name", "role", "weight"]))
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
        """Return frame_id -> weight in training, in [0, 1]. Only the stage ``rva`` has weights."""
        table = self.table("frames")
        return dict(zip(table["frame_id"].to_pylist(), table["weight"].to_pylist(), strict=True))


def open_prepared(folder: StageResults | str | Path) -> Prepared:
    """Open the frames, cameras and sparse points of a finished ``ingest``.

    Args:
        folder: ``run["ingest"]`` or its folder.

    Example:
        run = cg.open_run("run")
        capture = cg.open_prepared(run["ingest"])
        views = capture.views(run["rva"].weights())
    """
    from cleargs.capture.tables import load_frames, load_points

    path = folder.folder if isinstance(folder, StageResults) else Path(folder)
    return Prepared(path, load_frames(path), load_points(path))


@dataclass(frozen=True, eq=False)
class Prepared:
    """A capture with poses, in normalised coordinates: the farthest camera has distance 1 from the origin."""

    folder: Path
    frames: list[Frame]
    """All frames by frame_id, including those without a pose."""
    points: Points

    def __repr__(self) -> str:
        posed = sum(frame.registered for frame in self.frames)
        return f"<capture in {self.folder}: {len(self.frames)} frames, {posed} with a pose>"

    def dataset(self, weights: Mapping[int, float] | None = None) -> ViewDataset:
        """Return `views` as a dataset of torch.

        Example:
            capture = cg.open_prepared(cg.open_run("run")["ingest"])
            item = capture.dataset()[0]
            print(item["image"].shape, item["K"])
        """
        from cleargs.splat.views import ViewDataset

        return ViewDataset(self.views(weights))

    def to_nerfstudio(
        self,
        folder: str | Path,
        weights: Mapping[int, float] | None = None,
        *,
        repeat: int = 1,
        sharper: Callable[[int], Deblurred | None] | None = None,
    ) -> Path:
        """Write the capture into a new folder, for nerfstudio, gsplat and other trainers of COLMAP projects.

        The folder has ``transforms.json`` with the split and the sparse points, for nerfstudio; a COLMAP
        project (``images``, ``sparse/0``) whose order makes every 8th image a held-out one where their number
        allows it, for gsplat's ``simple_trainer``; ``split.json`` with the same split, names and weights; and
        ``masks`` where the capture has some. All poses are in normalised coordinates.

        Args:
            folder: The new folder.
            weights: frame_id -> weight, such as ``run["rva"].weights()``. Training frames of weight 0 are
                left out.
            repeat: For trainers that know no weights: a training frame of weight w is written
                ``repeat * w`` times, rounded, and at least once.
            sharper: Function of a frame_id that returns the image to write in place of a training frame as
                filmed, or None: ``functools.partial(cg.deblur, run)``.

        Raises:
            InputError: if the folder is in the input, or the run is packed.
            StoreError: if the folder exists or cannot be written.

        Example:
            run = cg.open_run("run")
            cg.open_prepared(run["ingest"]).to_nerfstudio("for-gsplat", run["rva"].weights())
        """
        from cleargs.handover import write_handover

        cameras, target = self.cameras(), Path(folder)
        return write_handover(
            self.folder, self.frames, self.points, cameras, target, weights, repeat, sharper
        )

    def views(self, weights: Mapping[int, float] | None = None) -> list[TrainingView]:
        """Return the views of a training: the frames with a pose that are not held out.

        Args:
            weights: frame_id -> weight (default: 1 for all). Frames with weight 0 are left out.

        Returns:
            Views that read their images when these are needed.
        """
        from cleargs.scene.views import real_views

        require_images(self.folder.parent, "training")
        given = {frame.frame_id: 1.0 for frame in self.frames} if weights is None else weights
        return real_views(self.frames, given, self.folder)

    def cameras(self) -> dict[int, Camera]:
        """Return frame_id -> camera for all frames with a pose, including held-out frames."""
        from cleargs.scene.views import camera_of

        posed = (frame for frame in self.frames if frame.registered)
        return {frame.frame_id: camera_of(frame) for frame in posed}
