"""``RUN/report/index.html``: the report of a run, a page that needs no server and no network."""

from __future__ import annotations

import filecmp
import json
import os
import shlex
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import tomli_w
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from matplotlib.ticker import MaxNLocator
from rich.filesize import decimal

import cleargs
from cleargs.errors import InputError
from cleargs.files import whole_folder
from cleargs.manifest import plain_json
from cleargs.parquet import read_table
from cleargs.pipeline.config import Config, load_config, recipe_names
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.plan import Planner, StagePlan
from cleargs.pipeline.run_file import RunSpec
from cleargs.pipeline.settings import flattened
from cleargs.report.formatting import duration
from cleargs.report.frames import (
    CHOICES,
    LAYERS,
    MEANINGS,
    SCENES,
    FrameRow,
    ImageFile,
    camera_of,
    load_rows,
    scores_of,
    write_jpeg,
    write_pictures,
)
from cleargs.report.report_json import PAGE, LastRun, last_run, linked_manifests, page_of, write_report_json
from cleargs.report.verdict import ReportVerdict
from cleargs.report.web_scene import level_camera, opening_frame, viewer_data, write_scene, write_viewer
from cleargs.rva.tables import B_CUES, R_CUES
from cleargs.splat.backend import set_threads
from cleargs.splat.ply import read_ply
from cleargs.splat.render import Viewer
from cleargs.splat.tables import TRAIN

_STILL = 960  # long side of the images that are shown until the 3D viewers have loaded, px


def write_page(folder: Path, template: str | Template, **values: Any) -> None:
    """Write ``index.html`` from a template.

    Args:
        folder: Folder of the page.
        template: A template, or the name of one of the report's templates.
        values: Variables of the template. Their text is escaped.
    """
    html = page_environment().get_template(template).render(version=cleargs.__version__, **values)
    (folder / PAGE).write_bytes(html.encode())


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
    environment.filters |= {"json": json_in_html, "duration": duration, "bytes": decimal}
    environment.globals["static"] = lambda name: Markup(static.joinpath(name).read_text(encoding="utf-8"))
    environment.globals["weight_colour"] = weight_colour
    return environment


def write_report(planner: Planner, last: LastRun | None = None) -> Path:
    """Write the report of a run atomically, in place of an older one.

    Args:
        planner: Planner of the run.
        last: The work of the last ``cleargs run`` (default: as in the older report).

    Returns:
        The path of the page.

    Raises:
        InputError: if no stage of the run is finished.
        StoreError: if a result cannot be read, or if the report cannot be written.
    """
    run = planner.run.folder
    manifests = linked_manifests(run, planner.dag.names)
    if "ingest" not in manifests:
        raise InputError(f"no stage of {run} is finished", hint=f"see cleargs status {run}")
    last = last or last_run(run)
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
    with whole_folder(page_of(run).parent, replace=True) as folder:
        scenes, final = _scenes(folder, run, trained, placed) if trained and placed else ([], None)
        pictures = write_pictures(rows, run, folder, final, planner.threads)
        viewer, times = viewer_data(placed, scenes) if scenes else (None, {})
        write_page(
            folder,
            "report.html.jinja",
            name=run.name,
            source=planner.run.source.name,
            pictures=pictures,
            verdict=ReportVerdict(manifests, rows, planner.run.config),
            scenes=scenes,
            viewer=write_viewer(folder) if scenes else "",
            camera_map=camera_map(rows),
            curves=training_curves(run, trained),
            bars=fitted_bars(rows),
            stages=planner.dag.names,
            manifests=manifests,
            plans=plans,
            last=last,
            settings=changed_settings(planner.run.config),
            versions=versions,
            command=command(planner.run, planner.dag),
            aspect=f"{rows[0].frame.width} / {rows[0].frame.height}" if rows else "16 / 9",
            data={
                "layers": LAYERS,
                "opening": {"left": "observed", "right": "final"},
                "frames": [
                    _frame_data(row, pictures[number][1], times.get(number))
                    for number, row in zip(pictures, rows, strict=True)
                ],
                "viewer": viewer,
            },
        )
        write_report_json(folder, manifests, last)
    return page_of(run)


def _scenes(
    folder: Path, run: Path, trained: Sequence[str], placed: Sequence[FrameRow]
) -> tuple[list[dict[str, Any]], Viewer]:
    """Write the first and the last scene, each with a still.

    Returns:
        The data of both scenes for the template, and a renderer of the last scene.
    """
    camera = camera_of(opening_frame(placed).frame)
    factor = _STILL / max(camera.width, camera.height)
    still = level_camera(camera, *(max(1, round(factor * side)) for side in (camera.width, camera.height)))
    views: list[dict[str, Any]] = []
    for key, stage, what in (
        ("before", trained[0], "trained on the raw frames"),
        ("after", trained[-1], "trained further, with repairs"),
    ):
        file = run / stage / "scene.ply"
        unchanged = views and filecmp.cmp(file, run / trained[0] / "scene.ply", shallow=False)
        scene = read_ply(file)
        renderer = Viewer(scene)
        views.append(
            {
                "key": key,
                "title": key.capitalize(),
                "what": "the same scene, since no repair changed it" if unchanged else what,
                "stage": stage,
                "gaussians": scene.gaussians.num,
                "still": write_jpeg(folder, f"{key}.jpg", renderer.view(still), _STILL),
                "sh_degree": scene.gaussians.sh_degree,
                "shown_degree": write_scene(folder / f"scene-{key}.js", key, scene),
                "antialias": scene.antialias,
                "background": scene.background,
            }
        )
    return views, renderer


def changed_settings(config: Config) -> list[tuple[str, str, str, str]]:
    """Return name, value, default and meaning of each setting that differs from its default."""
    return [
        (setting.name, _toml(value), _toml(setting.default), setting.meaning)
        for setting, value in config.settings()
        if value != setting.default
    ]


def command(run: RunSpec, dag: Dag) -> str:
    """Return the ``cleargs run`` command that reproduces a run, to be called next to its folder."""
    settings = dict(flattened(run.config.document()))
    candidates = []
    for recipe in ("default", *(name for name in recipe_names() if name != "default")):
        from_recipe = dict(flattened(load_config(dag, recipe).document()))
        changed = {name: value for name, value in settings.items() if from_recipe.get(name) != value}
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
    """Return ``value`` in TOML, or "unset" for None."""
    if value is None:
        return "unset"
    return " ".join(tomli_w.dumps({"v": value}).removeprefix("v = ").split())


def _frame_data(row: FrameRow, layers: Mapping[str, ImageFile], time: float | None) -> dict[str, Any]:
    """Return the data of a frame for the page; ``time`` is its time in the viewer's animation, in seconds."""
    lacking = {f"low {name}": row.judged.get(f"r_{name}") for name in R_CUES}
    cues = {name: 1.0 - value for name, value in lacking.items() if value is not None}
    harms = {name.replace("_", " "): row.judged.get(f"b_{name}") for name in B_CUES}
    cues |= {name: value for name, value in harms.items() if value is not None}
    repair, why, scores = "none tried", "", {}
    if row.selection:
        choice = CHOICES[row.selection.chosen]
        repair = choice if row.chosen else f"none: {choice} was refused"
        scores = dict(scores_of(row.selection))
        metric, deciding = scores_of(row.selection)[0]
        found = ", ".join(f"{name} {score:.1f}" for name, score in deciding.items())
        why = f"{row.selection.reason}; {metric}: {found}"
    fitted = {"blur, px": row.motion("blur_px"), "exposure, stops": row.gain_ev}
    return {
        "id": row.frame.frame_id,
        "name": row.frame.name,
        "role": row.role,
        "weight": row.weight,
        "figures": {name: row.judged[name] for name in "RBGCDOZ" if row.judged.get(name) is not None},
        "cues": dict(sorted(cues.items(), key=lambda item: -item[1])),  # the worst first
        "repair": repair,
        "why": why,
        "chosen": row.selection.chosen if row.selection and row.selection.accepted else None,
        "scores": scores,
        "found": {name: value for name, value in fitted.items() if value is not None},
        "model": row.formation.get("model"),
        "formation": [
            {"name": name.replace("_", " "), "value": value, "meaning": MEANINGS.get(name, "")}
            for name, value in row.formation.items()
        ],
        "layers": {name: picture.path for name, picture in layers.items()},
        "time": time,
    }


# -- drawings: SVG paths of curves, and a map of the cameras -------------------------------------------------


WIDTH, HEIGHT = 640, 220
"""Size of a curve's drawing area, in SVG units."""

_POINTS = 120  # maximum number per curve
_LOW, _HIGH = np.array([222.0, 135.0, 38.0]), np.array([22.0, 146.0, 138.0])  # amber, teal


def training_curves(run: Path, stages: Sequence[str]) -> list[dict[str, Any]]:
    """Return the curves of loss, PSNR and number of Gaussians over the training steps.

    Loss and PSNR are those of raw frames. Positions of ticks, and of the starts of the trainings (``parts``),
    are in the units of `WIDTH` and `HEIGHT`. Raises StoreError if a table cannot be read.
    """
    paths = {stage: run / stage / "train.parquet" for stage in stages}
    tables = {stage: read_table(path, TRAIN) for stage, path in paths.items() if path.is_file()}
    tables = {stage: table for stage, table in tables.items() if table.num_rows}
    if not tables:
        return []
    steps = pa.concat_tables(tables.values())
    real = np.array(steps["kind"].to_pylist()) == "real"
    starts = np.cumsum([0, *(table.num_rows for table in tables.values())])
    parts = [(start / len(real) * WIDTH, stage) for start, stage in zip(starts, tables, strict=False)]

    def curve(title: str, unit: str, name: str, digits: int, *, only_real: bool) -> dict[str, Any]:
        values = steps[name].to_numpy().astype(np.float64)
        known = np.flatnonzero(real & np.isfinite(values)) if only_real else np.arange(len(values))
        # Medians over equal intervals: each step shows one view, and views differ more than steps.
        intervals = np.array_split(known, min(_POINTS, max(1, len(known) // 6)))
        x = np.array([part.mean() for part in intervals]) / max(len(values) - 1, 1) * WIDTH
        y = np.array([np.median(values[part]) for part in intervals])
        ticks = MaxNLocator(5, steps=(1, 2, 2.5, 5, 10)).tick_values(float(y.min()), float(y.max()))
        down = np.interp(y, (ticks[0], ticks[-1]), (HEIGHT, 0.0))
        return {
            "title": title,
            "unit": unit,
            "path": "M" + " L".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, down, strict=True)),
            "ticks": list(zip(np.linspace(HEIGHT, 0.0, len(ticks)), (f"{t:,g}" for t in ticks), strict=True)),
            "parts": parts,
            "steps": len(values),
            "first": f"{y[0]:,.{digits}f}",
            "last": f"{y[-1]:,.{digits}f}",
        }

    return [
        curve("PSNR on training frames", "dB", "psnr", 1, only_real=True),
        curve("Loss", "", "loss", 3, only_real=True),
        curve("Gaussians", "", "n_gaussians", 0, only_real=False),
    ]


def weight_colour(weight: float) -> str:
    """Return a colour from amber (weight 0) to teal (weight 1), which works for any colour vision."""
    red, green, blue = np.rint(_LOW + (_HIGH - _LOW) * min(max(weight, 0.0), 1.0)).astype(int)
    return f"#{red:02x}{green:02x}{blue:02x}"


def camera_map(rows: Sequence[FrameRow]) -> dict[str, Any] | None:
    """Return a map of the placed frames from above, with x to the right and z upwards, in SVG units.

    The ``tip`` of a mark is the end of a line in the viewing direction. The result is None without placed
    frames.
    """
    placed = [row for row in rows if row.frame.registered]
    if not placed:
        return None
    cameras = [camera_of(row.frame) for row in placed]
    centres = np.array([camera.centre[[0, 2]] for camera in cameras]) * [1.0, -1.0]
    directions = np.array([camera.world_to_camera[2, [0, 2]] for camera in cameras]) * [1.0, -1.0]
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    low, high = centres.min(axis=0), centres.max(axis=0)
    scale = 520.0 / max(float((high - low).max()), 1e-6)
    size = (high - low) * scale
    height = float(np.clip(size[1], 160.0, 420.0))
    at = (centres - (low + high) / 2.0) * min(scale, height / max(float(high[1] - low[1]), 1e-6))
    at += np.array([size[0], height]) / 2.0 + 60.0
    marks = [
        {
            "frame_id": row.frame.frame_id,
            "x": round(float(x), 1),
            "y": round(float(y), 1),
            "radius": 5.0 + 3.0 * (row.weight or 0.0),
            "colour": weight_colour(row.weight or 0.0),
            "tip": (round(float(x + 26 * dx), 1), round(float(y + 26 * dy), 1)),
            "active": bool(row.weight),
        }
        for row, (x, y), (dx, dy) in zip(placed, at, directions, strict=True)
    ]
    path = "M" + " L".join(f"{mark['x']},{mark['y']}" for mark in marks)
    return {"width": float(size[0]) + 120.0, "height": height + 120.0, "path": path, "marks": marks}


def fitted_bars(rows: Sequence[FrameRow]) -> list[dict[str, Any]]:
    """Return bar charts of the fitted camera effects, with pairs of frame_id and value as ``known``."""
    bars = []
    for title, unit, found in (
        ("Motion blur", "px", [row.motion("blur_px") for row in rows]),
        ("Rolling shutter", "px", [row.motion("skew_px") for row in rows]),
        ("Defocus", "px", [row.formation.get("defocus_px") for row in rows]),
        ("Exposure", "stops", [row.gain_ev for row in rows]),
    ):
        numbered = zip(rows, found, strict=True)
        known = [(row.frame.frame_id, float(value)) for row, value in numbered if value is not None]
        if not known:
            continue
        values = [value for _, value in known]
        summary = f"median {np.median(values):.1f} {unit}, at most {max(values):.1f} {unit}"
        if unit == "stops":
            summary = f"from {min(values):+.2f} to {max(values):+.2f} {unit}"
        span = {"low": min(0.0, *values), "high": max(0.0, *values) or 1.0}
        bars.append({"title": title, "unit": unit, "known": known, "summary": summary, **span})
    return bars
