"""``RUN/report/index.html``: a run as a page that opens from the disk, without a server or a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cleargs.errors import InputError
from cleargs.formation.exposure import read_exposure
from cleargs.manifest import Manifest
from cleargs.pipeline.plan import Planner, StagePlan
from cleargs.report import charts, facts, words
from cleargs.report.frame_pictures import LAYERS, FramePictures, Picture, write_jpeg, write_pictures
from cleargs.report.frame_strip import MEANINGS, SCENES, FrameRow, load_rows, scores_of
from cleargs.report.html import new_report, write_page
from cleargs.report.report_json import LastRun, linked_manifests, noted, page_of, write_record
from cleargs.report.verdict import judge
from cleargs.report.web_scene import (
    Renderer,
    camera_of,
    level_camera,
    opening,
    viewer_pose,
    viewer_settings,
    write_scene,
    write_viewer,
)
from cleargs.splat.backend import set_threads
from cleargs.splat.ply import read_ply

RENDERED = 40
"""Most frames at which the final scene is rendered, evenly along the trajectory: more would take too long."""

_STILL = 960  # px, long side of the pictures that stand for the viewers
_SECONDS_A_FRAME = 0.4  # of the flight along the trajectory

TITLES = {
    "before": ("Before", "trained on the frames as filmed"),
    "after": ("After", "trained on, repairs included"),
}
"""The two scenes, and what each is."""

UNCHANGED = "the same scene: no repair changed it"
"""What the second is where it has the bytes of the first."""


class SceneView(NamedTuple):
    """One of the two scenes."""

    key: str
    title: str
    what: str
    stage: str
    gaussians: int
    still: Picture
    sh_degree: int
    shown_degree: int
    antialias: bool
    background: tuple[float, float, float]


def write_report(planner: Planner, last: LastRun | None = None) -> Path:
    """Write the report of ``planner.run``, in place of an older one; returns its page.

    Without ``last``, what an older report noted of the last run is kept. The folder appears whole.

    Raises:
        InputError: when nothing of the run is done yet.
        StoreError: when a result cannot be read, or the report not be written.
    """
    run = planner.run.folder
    manifests = linked_manifests(run, planner.dag.names)
    if "ingest" not in manifests:
        raise InputError(f"nothing is done in {run} to report on", hint=f"see cleargs status {run}")
    last = last or noted(run)
    with new_report(run) as folder:
        _fill(folder, planner, manifests, last)
        write_record(folder, manifests, last)
    return page_of(run)


def _fill(folder: Path, planner: Planner, manifests: Mapping[str, Manifest], last: LastRun | None) -> None:
    """Write the page and all that it needs into ``folder``."""
    run = planner.run.folder
    set_threads(planner.threads)
    trained = [stage for stage in SCENES if stage in manifests]
    final = trained[-1] if trained else None
    rows = load_rows(run, manifests)
    placed = [row for row in rows if row.frame.registered]
    scenes, renderer = _scenes(folder, run, {stage: manifests[stage] for stage in trained}, placed)
    exposure = read_exposure(run / final / "exposure.parquet") if final else None

    def render(row: FrameRow, side: int) -> Any:
        camera = camera_of(row.frame)
        assert renderer is not None and exposure is not None  # asked for only where there is a scene
        smaller = camera.scaled(min(1.0, side / max(camera.width, camera.height)))
        return renderer(smaller, exposure.of(row.frame.frame_id))

    shown = placed[:: -(-len(placed) // RENDERED) or 1] if renderer else []
    rendered = frozenset(row.frame.frame_id for row in shown)
    pictures = write_pictures(rows, run, folder, render, rendered, planner.threads)
    times = {row.frame.frame_id: index * _SECONDS_A_FRAME for index, row in enumerate(placed)}
    write_page(
        folder,
        "report.html.jinja",
        name=run.name,
        source=planner.run.source.name,
        rows=rows,
        pictures=pictures,
        verdict=judge(manifests, rows, planner.run.config),
        scenes=scenes,
        viewer=write_viewer(folder) if scenes else "",
        plan=charts.plan_of(rows),
        curves=charts.training_curves(run, trained),
        bars=charts.fitted_bars(rows),
        stages=facts.stage_rows(planner.dag.names, manifests, _plans(planner), last.stages if last else {}),
        total=words.duration(sum(manifest.seconds for manifest in manifests.values())),
        memory=f"{last.peak_memory_gb:.1f} GB" if last else None,
        device=list(manifests.values())[-1].device,
        started=next(iter(manifests.values())).started.replace("T", " ").removesuffix("+00:00"),
        settings=facts.changed_settings(planner.run.config),
        versions=facts.versions(manifests),
        command=facts.command(planner.run, planner.dag),
        layers=LAYERS,
        aspect=f"{rows[0].frame.width} / {rows[0].frame.height}" if rows else "16 / 9",
        data={
            "layers": LAYERS,
            "opening": {"left": "observed", "right": "final"},
            "frames": [
                _frame_data(row, pictures[row.frame.frame_id], times.get(row.frame.frame_id)) for row in rows
            ],
            "viewer": _viewer_data(placed, scenes) if scenes else None,
        },
    )


def _scenes(
    folder: Path, run: Path, trained: Mapping[str, Manifest], placed: Sequence[FrameRow]
) -> tuple[list[SceneView], Renderer | None]:
    """Write the first and the last scene, each with a still; and what renders the last."""
    if not trained or not placed:
        return [], None
    first, *_, last = [*trained] * 2
    unchanged = trained[first].files["scene.ply"] == trained[last].files["scene.ply"]
    views: list[SceneView] = []
    renderer = None
    start = placed[opening([row.weight or 0.0 for row in placed])]
    for key, stage in (("before", first), ("after", last)):
        scene = read_ply(run / stage / "scene.ply")
        renderer = Renderer(scene)
        camera = camera_of(start.frame)
        longer = max(camera.width, camera.height)
        size = [max(1, round(_STILL / longer * side)) for side in (camera.width, camera.height)]
        still = write_jpeg(folder, f"{key}.jpg", renderer(level_camera(camera, *size)), _STILL)
        degree = write_scene(folder / f"scene-{key}.js", key, scene)
        views.append(
            SceneView(
                key,
                TITLES[key][0],
                UNCHANGED if unchanged and key == "after" else TITLES[key][1],
                stage,
                scene.gaussians.num,
                still,
                scene.gaussians.sh_degree,
                degree,
                scene.antialias,
                scene.background,
            )
        )
    return views, renderer


def _plans(planner: Planner) -> dict[str, StagePlan]:
    """The state of every stage; empty when the capture has gone."""
    try:
        return {plan.stage: plan for plan in planner.plan()}
    except InputError as error:
        planner.reporter.warn(f"whether the results are still those of the input is unknown: {error}")
        return {}


# -- what the scripts of the page know ----------------------------------------------------------------------


def _frame_data(row: FrameRow, pictures: FramePictures, time: float | None) -> dict[str, Any]:
    found = {"blur, px": row.blur_px, "exposure, stops": row.gain_ev}
    return {
        "id": row.frame.frame_id,
        "name": row.frame.name,
        "role": row.role,
        "weight": row.weight,
        "figures": {name: row.judged[name] for name in "RBGCDOZ" if row.judged.get(name) is not None},
        "cues": row.cues,
        "repair": row.repair,
        "why": row.why,
        "chosen": row.selection.chosen if row.selection and row.selection.accepted else None,
        "scores": dict(scores_of(row.selection)) if row.selection else {},
        "found": {name: value for name, value in found.items() if value is not None},
        "formation": [
            {"name": name.replace("_", " "), "value": value, "meaning": MEANINGS.get(name, "")}
            for name, value in row.formation.items()
        ],
        "layers": {name: picture.path for name, picture in pictures.layers.items()},
        "time": time,
    }


def _viewer_data(placed: Sequence[FrameRow], scenes: Sequence[SceneView]) -> dict[str, Any]:
    """The settings of the two viewers (SuperSplat Viewer's schema, version 2), and their scenes.

    The trajectory is an animation track: its keys are the frames' poses, to which the page goes by time.
    """
    poses = [viewer_pose(camera_of(row.frame)) for row in placed]
    start = opening([row.weight or 0.0 for row in placed])
    track = {
        "name": "trajectory",
        "duration": max(_SECONDS_A_FRAME * len(poses), _SECONDS_A_FRAME),
        "frameRate": 1 / _SECONDS_A_FRAME,
        "loopMode": "none",
        "interpolation": "spline",
        "smoothness": 1,
        "keyframes": {
            "times": list(range(len(poses))),
            "values": {
                "position": [x for pose in poses for x in pose["position"]],
                "target": [x for pose in poses for x in pose["target"]],
                "fov": [pose["fov"] for pose in poses],
            },
        },
    }
    return {
        "scenes": [
            {"key": scene.key, "antialias": scene.antialias, "background": scene.background}
            for scene in scenes
        ],
        "start": start * _SECONDS_A_FRAME,
        "settings": {
            **viewer_settings(),
            "background": {"color": list(scenes[-1].background)},
            "animTracks": [track],
            "cameras": [{"initial": poses[start]}],
            "annotations": [],
            "startMode": "animTrack",
        },
    }
