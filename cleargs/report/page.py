"""``RUN/report/index.html``: the report of a run, a page that needs no server and no network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from shlex import quote
from typing import Any

from cleargs.errors import InputError
from cleargs.files import whole_folder, write_bytes
from cleargs.named_views import read_views
from cleargs.pipeline.plan import Planner, StagePlan
from cleargs.program import program
from cleargs.report.advice import command, shown_advice
from cleargs.report.frames import MEANINGS, SCENES, FrameRow, load_rows, scene_with_models
from cleargs.report.html import page_html
from cleargs.report.outcome import FAIR_DB, outcome
from cleargs.report.page_data import changed_settings, frame_data, training_curves
from cleargs.report.pictures import LAYERS, write_jpeg, write_pictures
from cleargs.report.report_json import (
    ENTRY,
    PAGE,
    cameras_of,
    linked_manifests,
    page_of,
    require_own,
    write_report_json,
)
from cleargs.report.single_file import single_file_size
from cleargs.report.web_scene import LICENCE, opening_frame, viewer_data, write_scene, write_viewer
from cleargs.run_results import edited_scene
from cleargs.scene.folder import SCENE, SceneFolder
from cleargs.scene.views import camera_of
from cleargs.splat.backend import set_threads
from cleargs.splat.render import Viewer
from cleargs.splat.scene import Scene

_STILL = 960  # long side of the image that is shown until the 3D viewer has loaded, px


def write_report(planner: Planner, edited: Path | None = None) -> Path:
    """Write the report of a run atomically, in place of an older one. Return the path of its page.

    It shows the last scene of the run, or the file ``edited``, an edited copy of it. Raises InputError
    if no stage of the run is finished or the copy has another place, and StoreError if a result is damaged or
    the report cannot be written.
    """
    run = planner.run.folder
    manifests = linked_manifests(run, planner.dag.names)
    if "ingest" not in manifests:
        raise InputError(f"no stage of {run} is finished", hint=f"see cleargs status {run}")
    require_own(run)
    set_threads(planner.threads)
    rows = load_rows(run, manifests)
    placed = [row for row in rows if row.frame.registered]
    trained = [stage for stage in SCENES if stage in manifests]
    plans: dict[str, StagePlan] = {}
    try:
        plans = {plan.stage: plan for plan in planner.plan()}
    except InputError as error:  # the capture was deleted or moved
        planner.reporter.warn(f"the report cannot say if the results are up to date: {error}")
    versions: dict[str, str] = {}
    for manifest in manifests.values():
        versions |= {**manifest.versions, **manifest.parts.libraries}
    changed = edited_scene(run, trained[-1], edited) if edited and trained else None
    with (
        planner.reporter.task("writing the report"),
        whole_folder(page_of(run).parent, replace=True) as folder,
    ):
        scene, final, viewer = None, None, ""
        if trained and placed:
            scene, final = _write_scene(folder, run, trained[-1], placed, changed)
            scene["edited"] = edited.name if edited else ""
            viewer = write_viewer(folder)
        models = scene_with_models(rows, run, manifests)
        if models and changed:
            models.scene = changed
        pictures = write_pictures(rows, run, folder, final, models, planner.threads)
        settings, times = viewer_data(placed, scene, read_views(run)) if scene else (None, {})
        frames = [
            frame_data(row, pictures[number], times.get(number))
            for number, row in zip(pictures, rows, strict=True)
        ]
        unseen = [found.psnr for found in pictures.values() if found.psnr is not None]
        html = page_html(
            "report.html.jinja",
            name=run.name,
            source=planner.run.source.name,
            pictures=pictures,
            outcome=outcome(manifests, rows, unseen),
            advice=shown_advice(planner, manifests, rows),
            scene=scene,
            views=settings["views"] if settings else [],
            films=sorted(file.name for file in run.glob("*.mp4")),
            viewer=viewer,
            licence=(folder / LICENCE).read_text(encoding="utf-8") if viewer else "",
            size=single_file_size(folder),
            stages=planner.run.stages(planner.dag),
            manifests=manifests,
            cameras=cameras_of(manifests),
            plans=plans,
            settings=changed_settings(planner.run.config),
            versions=versions,
            command=command(planner.run, planner.dag),
            program=program(run.parent),
            aspect=f"{rows[0].frame.width} / {rows[0].frame.height}" if rows else "16 / 9",
            data={
                "layers": {name: name for found in pictures.values() for name in found.layers} | LAYERS,
                "meanings": MEANINGS,
                "opening": {"left": "observed", "right": "final"},
                "poor": FAIR_DB,
                "program": f"{program(run.parent)} ",
                "shellName": quote(run.name),
                "start": opening_frame(placed).frame.frame_id if scene else None,
                "frames": frames,
                "viewer": settings,
                "training": training_curves(run, trained),
            },
        )
        (folder / PAGE).write_bytes(html)
        write_report_json(folder, manifests)
    write_bytes(run / ENTRY, page_html("entry.html.jinja", name=run.name, program=program(run.parent)))
    return page_of(run)


def _write_scene(
    folder: Path, run: Path, stage: str, placed: Sequence[FrameRow], edited: Scene | None
) -> tuple[dict[str, Any], Viewer]:
    """Write the last scene or its ``edited`` copy, with a still.

    Return its data for the template, and its renderer.
    """
    camera = camera_of(opening_frame(placed).frame)
    still = camera.scaled(_STILL / max(camera.width, camera.height))
    scene = edited or SceneFolder(run / stage).scene()
    renderer = Viewer(scene)
    data = {
        "gaussians": scene.gaussians.num,
        "still": write_jpeg(folder, "scene.jpg", renderer.view(still), _STILL),
        "sh_degree": scene.gaussians.sh_degree,
        "shown_degree": write_scene(folder / "scene.js", "scene", scene),
        "antialias": scene.antialias,
        "background": scene.background,
        "file": f"../{stage}/{SCENE}",
        "bytes": (run / stage / SCENE).stat().st_size,
    }
    return data, renderer
