"""The Python API: the functions of ``import cleargs as cg``.

Images are [H, W, 3] sRGB, uint8 or float32 in [0, 1]. Errors are `CleargsError` with a ``hint``. The examples
use a capture ``room`` and its run folder ``run``.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cleargs.errors import InputError
from cleargs.pipeline.config import check_document
from cleargs.pipeline.dag import installed
from cleargs.pipeline.session import DeviceChoice, default_folder, opened_store, resolve_run, usable_cores
from cleargs.progress import LineReporter, Reporter, Say, log_reporter
from cleargs.run_results import SCENE, Prepared, Run, open_prepared
from cleargs.splat.budget import resolve_config
from cleargs.splat.config import Quality

if TYPE_CHECKING:
    import pyarrow as pa

    from cleargs import G0Config
    from cleargs.evaluate.config import EvalOptions
    from cleargs.evaluate.eval_report import Evaluation
    from cleargs.rivr.distillation import Deblurred
    from cleargs.splat.camera import Camera
    from cleargs.splat.config import TrainConfig
    from cleargs.splat.formation import Formation
    from cleargs.splat.scene import Scene
    from cleargs.splat.trainer import Trained
    from cleargs.splat.types import Render
    from cleargs.splat.views import TrainingView
    from cleargs.types import AnyImage, ImageF32

Progress = Reporter | Say | None
"""Receiver of progress and remarks: the logger ``cleargs`` (None), a function that receives lines, or a
`cleargs.progress.Reporter`."""


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
    workflow: str | None = None,
) -> Run:
    """Turn a capture into a clean scene in the run folder ``folder``, as ``cleargs run`` does.

    Results that are up to date are reused. Finished stages stay if a later stage fails.

    Args:
        source: A video, an image folder, a COLMAP project, or a folder with ``transforms.json``.
        folder: The run folder, which is created if necessary (default: next to the capture, as
            ``cleargs run`` chooses it).
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
        workflow: Former name of ``recipe``.

    Raises:
        InputError: if the capture or a setting cannot be used.
        StageError: if a stage fails.

    Example:
        run = cg.run("room", "run", until="rva", progress=print)
        print(run["rva"].summary)
    """
    from cleargs.pipeline.runner import Runner

    dag, reporter = installed(), _reporter(progress)
    dag.until(until)
    spec = resolve_run(
        dag,
        Path(source),
        default_folder(Path(source)) if folder is None else Path(folder),
        recipe=recipe or workflow,
        overrides=[
            *([f"g0.quality={quality}"] if quality else []),
            # Settings are parsed as TOML, which reads these JSON values too.
            *(f"{name}={json.dumps(x, ensure_ascii=False, default=str)}" for name, x in (set or {}).items()),
        ],
        seed=seed,
        store=None if store is None else Path(store),
        device=device,
        say=reporter.info,
    )
    with opened_store(spec.store) as opened:
        runner = Runner(dag, spec, opened, threads or usable_cores(), reporter)
        runner.run_until(until, force=force, allow_partial=allow_partial)
    return Run(spec.folder)


def initialise(
    capture: Prepared,
    views: Sequence[TrainingView] | None = None,
    config: G0Config | None = None,
    *,
    seed: int = 0,
) -> Scene:
    """Return a scene to start a training from: one Gaussian per sparse point, and more between them.

    Args:
        capture: The capture with poses and sparse points.
        views: Views that give the added Gaussians their depths and colours (default: all of ``capture``).
        config: Only ``sh_degree``, ``min_points``, ``budget``, ``quality``, ``antialias`` and ``background``
            have an effect.
        seed: Seed of the positions of the added Gaussians.

    Example:
        capture = cg.open_prepared(cg.open_run("run")["ingest"])
        scene = cg.initialise(capture, config=cg.G0Config(sh_degree=1))
    """
    from cleargs import G0Config
    from cleargs.capture.tables import load_observations
    from cleargs.splat.initialise import SparsePoints, starting_gaussians
    from cleargs.splat.scene import BLACK, Scene

    views = capture.views() if views is None else views
    config = resolve_config(config or G0Config(), views)
    points, observations = capture.points, load_observations(capture.folder)
    frame_ids = [view.frame_id for view in views]
    sparse = SparsePoints.seen_by(frame_ids, points.point_id, points.xyz, points.rgb, observations)
    gaussians = starting_gaussians(
        sparse,
        views,
        at_least=config.min_points,
        at_most=config.budget,
        sh_degree=config.sh_degree,
        seed=seed,
    )
    return Scene(gaussians, config.antialias, config.background or BLACK)


def train(
    scene: Scene,
    views: Sequence[TrainingView],
    config: TrainConfig | None = None,
    *,
    formation: Formation | None = None,
    seed: int = 0,
    checkpoint: str | Path | None = None,
    device: str = "cpu",
    progress: Progress = None,
) -> Trained:
    """Optimise a scene to match images of it.

    On a CPU the result depends only on the arguments, not on the number of threads.

    Args:
        scene: The scene to start from. It is not changed.
        views: Images with cameras and weights.
        config: Settings of the training.
        formation: Model of how a camera turns the sharp scene into an image. None compares the images with
            the render itself. `cleargs.formation.capture.CaptureFormation` also fits motion blur, rolling
            shutter and defocus.
        seed: Seed of all randomness.
        checkpoint: File from which an interrupted training resumes, with the same result.
        device: cpu or cuda.
        progress: Receiver of progress and remarks.

    Returns:
        An object with the trained ``scene`` and a table ``rows`` with one row per step.

    Raises:
        InputError: if no view has a weight above 0.

    Example:
        capture = cg.open_prepared(cg.open_run("run")["ingest"])
        start = cg.initialise(capture)
        trained = cg.train(start, capture.views(), cg.TrainConfig(steps=20))
        print(trained.rows["loss"][-1])
    """
    from cleargs.splat.config import TrainConfig
    from cleargs.splat.trainer import Trainer

    config = config or TrainConfig()
    with tempfile.TemporaryDirectory() as nowhere:
        if checkpoint is None:  # the interval is longer than any training: no checkpoint is written
            config = config.model_copy(update={"checkpoint_interval": 1_000_000})
        trainer = Trainer(scene, views, config, seed=(seed,), formation=formation, device=device)
        return trainer.run(
            checkpoint=Path(nowhere) / "none" if checkpoint is None else Path(checkpoint),
            reporter=_reporter(progress),
        )


def render_view(scene: Scene, camera: Camera) -> Render:
    """Render a scene. The result is differentiable by torch in the parameters of the Gaussians.

    Returns:
        ``image`` [H, W, 3] sRGB (may exceed 1), ``alpha`` [H, W], and ``depth`` [H, W]: the sum of weight
        times camera z. Divide ``depth`` by ``alpha`` for the mean depth in world units.

    Example:
        run = cg.open_run("run")
        camera = cg.open_prepared(run["ingest"]).cameras()[0]
        image = cg.render_view(run.scene(), camera).image.detach().numpy()
    """
    from cleargs.splat.render import render

    return render(scene.gaussians, camera, background=scene.background, antialias=scene.antialias)


def save(scene: Scene, path: str | Path) -> None:
    """Write a scene in the format that the file ending names: .ply, .compressed.ply, .sog, .spz, .glb, .usdc.

    Raises:
        InputError: for another ending.

    Example:
        cg.save(cg.open_run("run").scene(), "room.spz")
    """
    from cleargs.splat.formats import format_of, write_scene

    write_scene(Path(path), scene, format_of(Path(path)))


def load(path: str | Path) -> Scene:
    """Read a PLY file with Gaussians, as ClearGS and the Inria code write it.

    Raises:
        StoreError: if the file cannot be read.

    Example:
        scene = cg.load("run/g0/scene.ply")
        print(scene.gaussians.num)
    """
    from cleargs.splat.ply import read_ply

    return read_ply(Path(path))


def export(run: Run, *files: str | Path, stage: str | None = None, **options: Any) -> list[str]:
    """Write the scene of a run to files for other programs, as ``cleargs export`` does.

    Args:
        run: A run with a trained scene.
        files: The new files. Their endings choose the formats (see `save`).
        stage: The stage whose scene is written (default: the last one that has a scene).
        options: Fields of `cleargs.render.export.ExportOptions`: ``up``, ``world``, ``metres``,
            ``sh_degree``, ``prune``, ``crop``, ``cameras``, ``force``.

    Returns:
        Messages about the result.

    Raises:
        InputError: if an option cannot be used, or if a file exists.

    Example:
        cg.export(cg.open_run("run"), "blender.ply", up="z", sh_degree=3)
    """
    from cleargs.render.export import ExportOptions, export_scene

    paths = [Path(file) for file in files]
    return export_scene(
        run.folder, run.scene_file(stage).parent.name, paths, ExportOptions(**options), log_reporter()
    )


def film(run: Run, file: str | Path, *, stage: str | None = None, **options: Any) -> Path:
    """Render a film (.mp4) along the path of the capture, or stills (.png, .exr), as ``cleargs render`` does.

    Args:
        run: A run with a trained scene.
        file: The new file.
        stage: The stage whose scene is rendered (default: the last one that has a scene).
        options: Fields of `cleargs.render.shots.ShotOptions`: ``frame``, ``turntable``, ``poses``, ``world``,
            ``size``, ``fps``, ``seconds``, ``side_by_side``, ``codec``.

    Raises:
        InputError: if an option cannot be used, or if the file exists.

    Example:
        cg.film(cg.open_run("run"), "still.png", frame=3)
    """
    from cleargs.render.shots import ShotOptions, render_run

    path = Path(file)
    render_run(run.scene_file(stage), path, ShotOptions(**options), log_reporter())
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


def score_frames(
    paths: Sequence[str | Path],
    *,
    evaluator: str = "statistics",
    threads: int | None = None,
    progress: Progress = None,
) -> pa.Table:
    """Rate the image quality of each frame of a video.

    Args:
        paths: Image files in the order in which they were filmed.
        evaluator: Evaluator of the cues: statistics, qwen3-vl, or one of an installed package.
        threads: Number of threads (default: all usable cores).
        progress: Receiver of progress and remarks.

    Returns:
        A table with one row per file: ``path``, RVA's eleven cues, the reliability ``R`` and the risk of
        degradation ``B``. All numbers are in [0, 1], or NaN for a frame that could not be scored.

    Raises:
        ConfigError: for an unknown evaluator.

    Example:
        from pathlib import Path

        paths = sorted(Path("room/images").iterdir())
        table = cg.score_frames(paths)
        print(table.sort_by("R").select(["path", "R", "B"]).slice(0, 3))
    """
    import pyarrow as pa

    from cleargs.rva.allocation import appearance_scores
    from cleargs.rva.evaluator import EvaluatedFrame
    from cleargs.rva.evaluators import make_evaluator
    from cleargs.rva.tables import CUE_COLUMNS

    config: Any = check_document(installed(), {"rva": {"evaluator": evaluator}}).sections["rva"]
    with tempfile.TemporaryDirectory() as cache:
        views = [EvaluatedFrame(number, Path(path)) for number, path in enumerate(paths)]
        cues = make_evaluator(config, cache=Path(cache)).evaluate(
            views, threads=threads or usable_cores(), reporter=_reporter(progress)
        )
    R, B = appearance_scores(cues, config)
    columns = dict(zip(CUE_COLUMNS, cues.T, strict=True))
    return pa.table({"path": [str(path) for path in paths], **columns, "R": R, "B": B})


def score(image: AnyImage, *, scorer: str = "clarity-net", threads: int | None = None) -> float:
    """Rate the quality of an image without a reference, from 0 to 100 (higher is better).

    Args:
        image: The image [H, W, 3], uint8 or float32 in [0, 1].
        scorer: clarity-net, naturalness-stats, an installed model (``cleargs models list``) or an ONNX file.
        threads: Number of threads (default: all usable cores).

    Raises:
        InputError: if the scorer is unknown, or if the image is smaller than 32 pixels.

    Example:
        import numpy as np

        image = np.random.default_rng(0).random((64, 96, 3), np.float32)
        print(cg.score(image))
    """
    from cleargs.models.scorer import load_scorer

    return load_scorer(scorer).score(_floats(image), threads=threads or usable_cores())


def restore(image: AnyImage, *, expert: str = "embedded", threads: int | None = None) -> ImageF32:
    """Restore a degraded image with a neural network.

    Args:
        image: The image [H, W, 3], uint8 or float32 in [0, 1].
        expert: embedded, an installed model (``cleargs models list``) or an ONNX file.
        threads: Number of threads (default: all usable cores).

    Returns:
        An image of the same size, float32 in [0, 1].

    Raises:
        InputError: if the expert is unknown.

    Example:
        import numpy as np

        image = np.random.default_rng(0).random((64, 96, 3), np.float32)
        print(cg.score(cg.restore(image)))
    """
    from cleargs.models.expert import load_expert

    return load_expert(expert).restore(_floats(image), threads=threads or usable_cores())


def deblur(run: Run, frame_id: int, *, stage: str | None = None) -> Deblurred | None:
    """Remove motion blur, rolling shutter and defocus from a raw frame, as fitted by a trained scene.

    Rolling shutter is removed only if the training detected it in the capture.

    Args:
        run: A run with a trained scene.
        frame_id: Number of a frame with a pose.
        stage: The stage that trained the scene (default: the last one that has a scene).

    Returns:
        ``image`` [H, W, 3], float32 sRGB in [0, 1], and ``formation``, the effects that were removed. None if
        no effect explains the frame better than the sharp render.

    Raises:
        InputError: if the frame has no pose.

    Example:
        deblurred = cg.deblur(cg.open_run("run"), 3)
        if deblurred is not None:
            print(deblurred.formation.blur_px, deblurred.image.shape)
    """
    from cleargs.formation.frames import view_of
    from cleargs.rivr.distillation import TrainedScene

    capture = open_prepared(run["ingest"])
    frame = next((frame for frame in capture.frames if frame.frame_id == frame_id), None)
    if frame is None or not frame.registered:
        raise InputError(f"frame {frame_id} has no pose", hint="see cleargs show RUN ingest")
    return TrainedScene(run.scene_file(stage).parent).deblur(view_of(frame, capture.folder, 1.0))


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
        scene: A run, a scene or a PLY file. The scene of a run is transformed to the coordinates of its
            input. Other scenes must be in the coordinates of the reference.
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

    directory, reporter = None if reference is None else Path(reference), _reporter(progress)
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


def _reporter(progress: Progress) -> Reporter:
    if progress is None:
        return log_reporter()
    if callable(progress):
        return LineReporter(progress, lambda text: progress(f"warning: {text}"), progress)
    return progress


def _floats(image: AnyImage) -> ImageF32:
    import numpy as np

    floats = image.astype(np.float32)
    return floats / np.float32(255) if image.dtype == np.uint8 else floats
