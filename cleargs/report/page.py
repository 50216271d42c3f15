"""``RUN/report/index.html``: the report of a run, a page that needs no server and no network."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import pyarrow as pa
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from rich.filesize import decimal

import cleargs
from cleargs.errors import InputError
from cleargs.files import whole_folder, write_bytes
from cleargs.manifest import plain_json
from cleargs.named_views import read_views
from cleargs.pipeline.config import Config
from cleargs.pipeline.plan import Planner, StagePlan
from cleargs.program import program
from cleargs.report.advice import command, shown_advice, toml_text
from cleargs.report.formatting import duration
from cleargs.report.frames import (
    MEANINGS,
    SCENES,
    FrameRow,
    faults_of,
    load_rows,
    scene_with_models,
    scores_of,
    worst_cue,
)
from cleargs.report.outcome import LOOSE_DB, outcome
from cleargs.report.pictures import LAYERS, FramePictures, write_jpeg, write_pictures
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
from cleargs.rivr.candidates import phrase_of
from cleargs.run_results import edited_scene
from cleargs.scene.folder import SCENE, SceneFolder
from cleargs.scene.views import camera_of
from cleargs.splat.backend import set_threads
from cleargs.splat.render import Viewer
from cleargs.splat.scene import Scene
from cleargs.splat.tables import TRAIN

_STILL = 960  # long side of the image that is shown until the 3D viewer has loaded, px


def page_html(template: str | Template, **values: Any) -> bytes:
    """Render ``template``, or the template of the report with this name. The values are escaped."""
    return page_environment().get_template(template).render(version=cleargs.__version__, **values).encode()


def json_in_html(value: Any) -> Markup:
    """Return ``value`` as JSON without characters that could end its script element."""
    text = json.dumps(plain_json(value), ensure_ascii=True, separators=(",", ":"))
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)


def page_environment() -> Environment:
    """Return the Jinja environment of the report's templates, with their filters and globals."""
    environment = Environment(
        loader=PackageLoader("cleargs.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    static = files("cleargs.report").joinpath("static")
    environment.filters |= {"json": json_in_html, "duration": duration, "bytes": decimal, "shell": quote}
    environment.globals["static"] = lambda name: Markup(static.joinpath(name).read_text(encoding="utf-8"))
    return environment


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
    with whole_folder(page_of(run).parent, replace=True) as folder:
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
                "poor": LOOSE_DB,
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


def changed_settings(config: Config) -> list[tuple[str, str, str, str]]:
    """Return name, value, default and meaning of each setting that differs from its default."""
    return [
        (setting.name, toml_text(value), toml_text(setting.default), setting.meaning)
        for setting, value in config.settings()
        if value != setting.default
    ]


def frame_data(row: FrameRow, pictures: FramePictures, time: float | None) -> dict[str, Any]:
    """Return the data of a frame for the page; ``time`` is its time in the viewer's animation, in seconds."""
    repair, why, scores = "none tried", "", {}
    if row.selection:
        choice = phrase_of(row.selection.chosen)
        refused = row.selection.chosen != "observed" and not row.chosen
        repair = f"kept as filmed, since {choice} was refused" if refused else choice
        scores = dict(scores_of(row.selection))
        why = row.selection.reason
    found = {
        "blur, px": row.motion("blur_px"),
        "rolling shutter, px": row.motion("skew_px"),
        "defocus, px": row.formation.get("defocus_px"),
        "exposure, stops": row.gain_ev,
        "camera speed, px per video frame": row.speed_px,
    }
    return {
        "id": row.frame.frame_id,
        "name": row.frame.name,
        "role": row.role,
        "weight": row.weight,
        "weight_text": row.weight_text,
        "psnr": row.psnr if pictures.psnr is None else pictures.psnr,
        "figures": {name: row.rated[name] for name in "RBGCDOZ" if row.rated.get(name) is not None},
        "worst": worst_cue(row.rated),
        "cues": dict(sorted(faults_of(row.rated).items(), key=lambda item: -item[1])),  # the worst first
        "repair": repair,
        "why": why,
        "chosen": row.chosen,
        "scores": scores,
        "found": {name: value for name, value in found.items() if value is not None},
        "formation": row.formation,
        "layers": {name: picture.path for name, picture in pictures.layers.items()},
        "time": time,
    }


_POINTS = 120  # maximum number per curve


def training_curves(run: Path, stages: Sequence[str]) -> dict[str, Any] | None:
    """Return loss, PSNR and number of Gaussians over the training steps; None before the first step.

    Loss and PSNR are those of steps on raw frames. They are medians over equal intervals: each step shows one
    view, and views differ more than steps. Raises StoreError if a table cannot be read.
    """
    logs = {stage: SceneFolder(run / stage).log() for stage in stages}
    tables = {stage: log for stage, log in logs.items() if log is not None}
    steps = pa.concat_tables([TRAIN.empty_table(), *tables.values()])
    real = np.array(steps["kind"].to_pylist()) == "real"
    if not real.any():
        return None
    curves: list[dict[str, Any]] = []
    for title, unit, name, digits in (
        ("PSNR on training frames", "dB", "psnr", 1),
        ("Loss", "", "loss", 3),
        ("Gaussians", "", "n_gaussians", 0),
    ):
        values = steps[name].to_numpy().astype(np.float64)
        known = np.flatnonzero(real & np.isfinite(values))
        intervals = np.array_split(known, min(_POINTS, max(1, len(known) // 6)))
        points = [(float(part.mean()), float(np.median(values[part]))) for part in intervals]
        curves.append({"title": title, "unit": unit, "digits": digits, "points": points})
    starts = np.cumsum([0, *(table.num_rows for table in tables.values())]).tolist()
    return {"steps": len(real), "parts": list(zip(tables, starts, strict=False)), "curves": curves}
