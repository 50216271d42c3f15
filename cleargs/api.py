"""The Python API: runs and their results.

Scenes and images without a run are in `cleargs.api_scenes` and `cleargs.api_images`.

``threads`` is the number of threads (default: all usable cores). Errors are `CleargsError` with a ``hint``.
The examples use a capture ``room`` and its run folder ``run``.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cleargs.api_scenes import save
from cleargs.capture.sources import whole_capture
from cleargs.pipeline.session import DeviceChoice, default_folder, opened_store, resolve_run, usable_cores
from cleargs.pipeline.stages import installed
from cleargs.progress import Progress, log_reporter, reporter_of
from cleargs.run_results import SCENE, Run, open_run, scene_stage
from cleargs.splat.config import Quality

if TYPE_CHECKING:
    from cleargs.evaluate.config import EvalOptions
    from cleargs.evaluate.eval_report import Evaluation
    from cleargs.splat.scene import Scene


def run(
    source: str | Path,
    folder: str | Path | None = None,
    *,
    recipe: str | None = None,
    quality: Quality | None = None,
    set: Mapping[str, Any] | None = None,
    until: str | None = None,
    force: Sequence[str] = (),
    allow_partial: bool = False,
    seed: int | None = None,
    device: DeviceChoice = "auto",
    threads: int | None = None,
    store: str | Path | None = None,
    progress: Progress = None,
) -> Run:
    """Turn a capture into a clean scene in the run folder ``folder``, as ``cleargs run`` does.

    Results that are up to date are reused. Finished stages stay if a later stage fails.

    Args:
        source: A video, an image folder, a COLMAP project, or a folder with ``transforms.json``.
        folder: The run folder (default: next to the capture, as ``cleargs run`` chooses it).
        recipe: Name or path of a recipe. Without one, an existing run keeps its settings.
        quality: Cost of the trainings: draft, standard or high (setting ``g0.quality``).
        set: Settings by name, for example ``{"rva.tau_R": 0.6}``.
        until: The last stage to run (default: all stages).
        force: Stages that run even if their results are up to date.
        allow_partial: Continue after a stage that could make only a part of its results.
        seed: Seed of all randomness (default: that of the run, or 0).
        device: auto, cpu or cuda.
        threads: Number of threads (default: all usable cores).
        store: Folder for results (default: that of the run, or ``.store`` in ``folder``).
        progress: Receiver of progress and remarks.

    Raises:
        InputError: if the capture or a setting cannot be used.
        StageError: if a stage fails.

    Example:
        run = cg.run("room", "run", until="rva", progress=print)
        print(run["rva"].summary)
    """
    from cleargs.pipeline.runner import Runner

    dag, reporter, capture = installed(), reporter_of(progress), whole_capture(Path(source))
    dag.until(until)
    spec = resolve_run(
        dag,
        capture,
        default_folder(capture) if folder is None else Path(folder),
        recipe=recipe,
        overrides=[
            *([f"g0.quality={quality}"] if quality else []),
            # Settings are parsed as TOML, which reads these JSON values too.
            *(f"{name}={json.dumps(x, ensure_ascii=False, default=str)}" for name, x in (set or {}).items()),
        ],
        seed=seed,
        store=None if store is None else Path(store),
        device=device,
        reporter=reporter,
    )
    with opened_store(spec.store) as opened:
        runner = Runner(dag, spec, opened, threads or usable_cores(), reporter)
        runner.run_until(until, force=force, allow_partial=allow_partial)
    return Run(spec.folder)


def export(run: Run, *files: str | Path, stage: str | None = None, **options: Any) -> list[str]:
    """Write the scene of a run to files for other programs, as ``cleargs export`` does.

    The endings of the ``files`` choose the formats (see `save`). ``stage`` is the stage whose scene is
    written (default: the last one that has a scene). ``options`` are fields of
    `cleargs.render.export.ExportOptions`: ``up``, ``world``, ``metres``, ``sh_degree``, ``prune``, ``crop``,
    ``cameras``, ``force``. Returns messages about the result. Raises InputError if an option cannot be used,
    or if a file exists.

    Example:
        cg.export(cg.open_run("run"), "blender.ply", up="z", sh_degree=3)
    """
    from cleargs.render.export import ExportOptions, export_scene

    paths, chosen = [Path(file) for file in files], scene_stage(installed(), run.folder, stage)
    return export_scene(run.folder, chosen, paths, ExportOptions(**options), log_reporter())


def film(run: Run, file: str | Path, *, stage: str | None = None, **options: Any) -> Path:
    """Render a film (.mp4) along the path of the capture, or stills (.png, .exr), as ``cleargs render`` does.

    ``stage`` is the stage whose scene is rendered (default: the last one that has a scene). ``options`` are
    fields of `cleargs.render.shots.ShotOptions`: ``frame``, ``turntable``, ``poses``, ``world``, ``size``,
    ``fps``, ``seconds``, ``side_by_side``, ``codec``. Raises InputError if an option cannot be used, or if
    the file exists.

    Example:
        cg.film(cg.open_run("run"), "still.png", frame=3)
    """
    from cleargs.render.shots import ShotOptions, render_run

    path = Path(file)
    chosen = scene_stage(installed(), run.folder, stage)
    render_run(run.folder, chosen, path, ShotOptions(**options), log_reporter())
    return path


def write_report(run: Run, *, threads: int | None = None) -> Path:
    """Write the report of a run. Return the path of its page.

    Example:
        page = cg.write_report(cg.open_run("run"))
    """
    from cleargs.pipeline.plan import Planner
    from cleargs.pipeline.run_file import read_run_file
    from cleargs.report.page import write_report

    dag = installed()
    spec = read_run_file(run.folder, dag)
    with opened_store(spec.store) as opened:
        return write_report(Planner(dag, spec, opened, threads or usable_cores(), log_reporter()))


def evaluate_scene(
    scene: Run | Scene | str | Path,
    reference: str | Path | None = None,
    *,
    stage: str | None = None,
    options: EvalOptions | None = None,
    threads: int | None = None,
    progress: Progress = None,
) -> Evaluation:
    """Compare renders of a scene with sharp reference images.

    Args:
        scene: A run or its folder, a scene or a PLY file. The scene of a run is transformed to the
            coordinates of its input. Other scenes must be in the coordinates of the reference.
        reference: A folder with ``images/`` and ``transforms.json`` (default: the held-out frames of the
            run).
        stage: The stage of the run whose scene is compared (default: the last one that has a scene).
        options: Metrics and their settings.
        threads: Number of threads (default: all usable cores).
        progress: Receiver of progress and remarks.

    Returns:
        The evaluation. Its ``means`` map the name of a metric to the mean over all images.

    Raises:
        InputError: if no image of the reference matches.

    Example:
        result = cg.evaluate_scene(cg.open_run("run"), "room/truth/observed")
        print(result.means["psnr"])
    """
    from cleargs.evaluate.config import EvalOptions
    from cleargs.evaluate.evaluate import evaluate_scene
    from cleargs.evaluate.references import reference_of
    from cleargs.splat.scene import Scene

    directory, reporter = None if reference is None else Path(reference), reporter_of(progress)
    if isinstance(scene, str | Path) and Path(scene).is_dir():
        scene = open_run(scene)
    run = scene.folder if isinstance(scene, Run) else None
    compared = reference_of(run, directory, reporter=reporter)
    with tempfile.TemporaryDirectory() as folder:
        if isinstance(scene, Scene):
            path = Path(folder) / SCENE
            save(scene, path)
        else:
            path = scene.scene_file(stage) if isinstance(scene, Run) else Path(scene)
        count = threads or usable_cores()
        return evaluate_scene(
            path, compared, options=options or EvalOptions(), threads=count, reporter=reporter
        )
