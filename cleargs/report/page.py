"""``RUN/report/index.html``: a run as a page that opens from the disk, without a server or a network."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from cleargs.errors import InputError
from cleargs.files import whole_folder
from cleargs.formation.exposure import read_exposure
from cleargs.manifest import Manifest
from cleargs.pipeline.config import Config, load_config, recipe_names
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.plan import Planner, StagePlan
from cleargs.pipeline.run_file import Run
from cleargs.pipeline.settings import flattened
from cleargs.report import charts
from cleargs.report.frame_pictures import LAYERS, Image, Picture, write_jpeg, write_pictures
from cleargs.report.frame_strip import MEANINGS, SCENES, FrameRow, load_rows, scores_of
from cleargs.report.html import write_page
from cleargs.report.report_json import LastRun, linked_manifests, noted, page_of, write_record
from cleargs.report.verdict import judge
from cleargs.report.web_scene import (
    camera_of,
    level_camera,
    opening,
    viewer_pose,
    viewer_settings,
    write_scene,
    write_viewer,
)
from cleargs.report.words import duration, size
from cleargs.splat.backend import set_threads
from cleargs.splat.ply import read_ply
from cleargs.splat.viewer import Viewer

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

STATES = {"done": "up to date", "partial": "done in part", "missing": "to be made"}
HOW = {"made": "made anew", "found": "found in the store"}
"""What the last ``cleargs run`` did."""


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
    with whole_folder(page_of(run).parent, replace=True) as folder:
        _fill(folder, planner, manifests, last)
        write_record(folder, manifests, last)
    return page_of(run)


def _fill(folder: Path, planner: Planner, manifests: Mapping[str, Manifest], last: LastRun | None) -> None:
    """Write the page and all that it needs into ``folder``."""
    run = planner.run.folder
    set_threads(planner.threads)
    trained = [stage for stage in SCENES if stage in manifests]
    rows = load_rows(run, manifests)
    placed = [row for row in rows if row.frame.registered]
    scenes, renderer = _scenes(folder, run, {stage: manifests[stage] for stage in trained}, placed)
    exposure = read_exposure(run / trained[-1] / "exposure.parquet") if trained else None

    def render(row: FrameRow, side: int) -> Image:
        camera = camera_of(row.frame)
        assert renderer is not None and exposure is not None  # asked for only where there is a scene
        smaller = camera.scaled(min(1.0, side / max(camera.width, camera.height)))
        return renderer.view(smaller, exposure.of(row.frame.frame_id))

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
        stages=_stage_rows(planner.dag.names, manifests, _plans(planner), last.stages if last else {}),
        total=duration(sum(manifest.seconds for manifest in manifests.values())),
        memory=f"{last.peak_memory_gb:.1f} GB" if last else None,
        device=list(manifests.values())[-1].device,
        started=next(iter(manifests.values())).started.replace("T", " ").removesuffix("+00:00"),
        settings=changed_settings(planner.run.config),
        versions=_versions(manifests),
        command=command(planner.run, planner.dag),
        aspect=f"{rows[0].frame.width} / {rows[0].frame.height}" if rows else "16 / 9",
        data={
            "layers": LAYERS,
            "opening": {"left": "observed", "right": "final"},
            "frames": [_frame_data(row, pictures[row.frame.frame_id][1], times) for row in rows],
            "viewer": _viewer_data(placed, scenes) if scenes else None,
        },
    )


def _scenes(
    folder: Path, run: Path, trained: Mapping[str, Manifest], placed: Sequence[FrameRow]
) -> tuple[list[dict[str, Any]], Viewer | None]:
    """Write the first and the last scene, each with a still; returns what the page says of them, and what
    renders the last."""
    if not trained or not placed:
        return [], None
    first, *_, last = [*trained] * 2
    views: list[dict[str, Any]] = []
    start = placed[opening([row.weight or 0.0 for row in placed])]
    for (key, (title, what)), stage in zip(TITLES.items(), (first, last), strict=True):
        if views and trained[first].files["scene.ply"] == trained[last].files["scene.ply"]:
            what = UNCHANGED
        scene = read_ply(run / stage / "scene.ply")
        renderer = Viewer(scene)
        camera = camera_of(start.frame)
        longer = max(camera.width, camera.height)
        size = [max(1, round(_STILL / longer * side)) for side in (camera.width, camera.height)]
        still = renderer.view(level_camera(camera, *size))
        views.append(
            {
                "key": key,
                "title": title,
                "what": what,
                "stage": stage,
                "gaussians": scene.gaussians.num,
                "still": write_jpeg(folder, f"{key}.jpg", still, _STILL),
                "sh_degree": scene.gaussians.sh_degree,
                "shown_degree": write_scene(folder / f"scene-{key}.js", key, scene),
                "antialias": scene.antialias,
                "background": scene.background,
            }
        )
    return views, renderer


def _plans(planner: Planner) -> dict[str, StagePlan]:
    """The state of every stage; empty when the capture has gone."""
    try:
        return {plan.stage: plan for plan in planner.plan()}
    except InputError as error:
        planner.reporter.warn(f"whether the results are still those of the input is unknown: {error}")
        return {}


# -- how the run came about ----------------------------------------------------------------------------------


def _stage_rows(
    names: Sequence[str],
    manifests: Mapping[str, Manifest],
    plans: Mapping[str, StagePlan],
    last: Mapping[str, str],
) -> list[dict[str, Any]]:
    """What each stage cost, and whether its results are those of today's settings and input.

    last: stage -> ``made`` or ``found``, as the last run had it.
    """
    total = sum(manifest.seconds for manifest in manifests.values()) or 1.0
    rows = []
    for name in names:
        manifest, plan = manifests.get(name), plans.get(name)
        rows.append(
            {
                "name": name,
                "state": STATES[plan.state] if plan else "unknown",
                "reasons": plan.reasons if plan else (),
                "how": HOW.get(last.get(name, ""), ""),
                "time": duration(manifest.seconds) if manifest else "",
                "share": manifest.seconds / total if manifest else 0.0,
                "size": size(manifest.bytes) if manifest else "",
                "key": manifest.key[:12] if manifest else "",
            }
        )
    return rows


def changed_settings(config: Config) -> list[tuple[str, str, str, str]]:
    """Name, value, default and meaning of each setting of the stages that differs from its default."""
    return [
        (setting.name, _toml(value), _toml(setting.default), setting.meaning)
        for setting, value in config.settings()
        if value != setting.default
    ]


def command(run: Run, dag: Dag) -> str:
    """The ``cleargs run`` that makes this run, called next to its folder: a recipe, then settings."""
    wanted = dict(flattened(run.config.document()))
    candidates = []
    for recipe in ("default", *(name for name in recipe_names() if name != "default")):
        have = dict(flattened(load_config(dag, recipe).document()))
        changed = {name: value for name, value in wanted.items() if have.get(name) != value}
        candidates.append((len(changed), recipe, changed))
    _, recipe, changed = min(candidates, key=lambda item: item[0])
    source = os.path.relpath(run.source, run.folder.parent)
    words = ["cleargs", "run", source, "-o", run.folder.name]
    words += ["--workflow", recipe] if recipe != "default" else []
    words += ["--seed", str(changed.pop("seed"))] if "seed" in changed else []
    for name, value in changed.items():
        words += ["--set", f"{name}={value if isinstance(value, str) else _toml(value)}"]
    return shlex.join(words)


def _toml(value: Any) -> str:
    """``value`` as TOML writes it; "unset" for None."""
    if value is None:
        return "unset"
    return " ".join(tomli_w.dumps({"v": value}).removeprefix("v = ").split())


def _versions(manifests: Mapping[str, Manifest]) -> dict[str, str]:
    """Program or library -> version, of all stages together."""
    found: dict[str, str] = {}
    for manifest in manifests.values():
        found |= {**manifest.versions, **{name: str(v) for name, v in manifest.parts.libraries.items()}}
    return found


# -- what the scripts of the page know ----------------------------------------------------------------------


def _frame_data(row: FrameRow, layers: Mapping[str, Picture], times: Mapping[int, float]) -> dict[str, Any]:
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
        "layers": {name: picture.path for name, picture in layers.items()},
        "time": times.get(row.frame.frame_id),
    }


def _viewer_data(placed: Sequence[FrameRow], scenes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
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
        "scenes": [{name: scene[name] for name in ("key", "antialias", "background")} for scene in scenes],
        "start": start * _SECONDS_A_FRAME,
        "settings": {
            **viewer_settings(),
            "background": {"color": list(scenes[-1]["background"])},
            "animTracks": [track],
            "cameras": [{"initial": poses[start]}],
            "annotations": [],
            "startMode": "animTrack",
        },
    }
