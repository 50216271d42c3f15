"""The library: what the command line does, for programs. ``import cleargs as cg`` brings these names.

Images are [H, W, 3] sRGB, uint8 or float32 in [0, 1]. Errors are `CleargsError` with a ``hint``.
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
from cleargs.pipeline.session import DeviceChoice, opened_store, resolve_run, usable_cores
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
"""Where progress and remarks go: to the logger ``cleargs`` (None), to a function that takes lines, or to a
`cleargs.progress.Reporter`."""


def run(
    source: str | Path,
    folder: str | Path,
    *,
    workflow: str | None = None,
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

    ``source`` is a video, an image folder, a COLMAP project, or a folder with ``transforms.json``. What is
    there already is not made again. ``quality`` says what trainings may cost; ``set`` changes settings by
    name: ``{"rva.tau_R": 0.6}``; an existing run keeps the others, unless a ``workflow`` is given. Raises
    InputError for what cannot be used as it is, StageError where a stage fails; what was finished stays.
    """
    from cleargs.pipeline.runner import Runner

    dag, reporter = installed(), _reporter(progress)
    dag.until(until)
    spec = resolve_run(
        dag,
        Path(source),
        Path(folder),
        workflow=workflow,
        overrides=[
            *([f"g0.quality={quality}"] if quality else []),
            # JSON's spelling of a value is TOML's too.
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
    """The scene that a training starts from: one Gaussian a sparse point, and more between them.

    ``views`` (default: all of ``capture``) give the colours of those in between; of ``config`` count
    ``sh_degree``, ``min_points``, ``budget``, ``quality``, ``antialias`` and ``background``.
    """
    from cleargs import G0Config
    from cleargs.capture.tables import load_observations
    from cleargs.splat.initialise import SparsePoints, starting_gaussians
    from cleargs.splat.scene import Scene

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
    return Scene(gaussians, config.antialias, config.background)


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
    """Optimise ``scene`` against ``views``; the result has ``scene``, and ``rows``, one a step.

    ``formation`` says what the cameras made of the sharp scene: None compares the images with the render as
    it is, `cleargs.formation.capture.CaptureFormation` finds blur, rolling shutter and defocus. With a
    ``checkpoint`` file a training that was cut off resumes from it, to the same result. On a CPU the result
    depends on the arguments alone, not on threads. Raises InputError without a weighted view.
    """
    from cleargs.splat.config import TrainConfig
    from cleargs.splat.trainer import Trainer

    config = config or TrainConfig()
    with tempfile.TemporaryDirectory() as nowhere:
        if checkpoint is None:  # never written then
            config = config.model_copy(update={"checkpoint_interval": 1_000_000})
        trainer = Trainer(scene, views, config, seed=(seed,), formation=formation, device=device)
        return trainer.run(
            checkpoint=Path(nowhere) / "none" if checkpoint is None else Path(checkpoint),
            reporter=_reporter(progress),
        )


def render_view(scene: Scene, camera: Camera) -> Render:
    """What ``scene`` shows at ``camera``: image, alpha and accumulated depth, differentiable by torch."""
    from cleargs.splat.render import render

    return render(scene.gaussians, camera, background=scene.background, antialias=scene.antialias)


def save(scene: Scene, path: str | Path) -> None:
    """Write ``scene`` in the format of the ending: .ply .compressed.ply .sog .spz .glb .usdc.

    Raises InputError for another ending.
    """
    from cleargs.splat.formats import format_of, write_scene

    write_scene(Path(path), scene, format_of(Path(path)))


def load(path: str | Path) -> Scene:
    """Read a ``scene.ply`` of ClearGS or of the Inria code. Raises StoreError when it cannot be read."""
    from cleargs.splat.ply import read_ply

    return read_ply(Path(path))


def score_frames(
    paths: Sequence[str | Path],
    *,
    evaluator: str = "statistics",
    threads: int | None = None,
    progress: Progress = None,
) -> pa.Table:
    """How good each frame of a video looks: a row a file, with RVA's eleven cues, R and B, all in [0, 1].

    ``paths`` are images in the order in which they were taken. A frame that could not be scored has NaN.
    Raises ConfigError for an unknown evaluator.
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
    """How good an image looks without a reference: 0 to 100, higher is better.

    ``scorer`` is clarity-net, naturalness-stats, an installed model (``cleargs models list``) or an ONNX
    file. Raises InputError for another name, and for an image smaller than 32 pixels.
    """
    from cleargs.models.scorer import load_scorer

    return load_scorer(scorer).score(_floats(image), threads=threads or usable_cores())


def restore(image: AnyImage, *, expert: str = "embedded", threads: int | None = None) -> ImageF32:
    """A sharper image of the same size [H, W, 3] by a restoration network, float32 in [0, 1].

    ``expert`` is embedded, an installed model or an ONNX file. Raises InputError for another name.
    """
    from cleargs.models.expert import load_expert

    return load_expert(expert).restore(_floats(image), threads=threads or usable_cores())


def deblur(run: Run, frame_id: int, *, stage: str | None = None) -> Deblurred | None:
    """A raw frame without the motion, rolling shutter and defocus that the scene of ``stage`` explains.

    A rolling shutter is undone only where the training found that the capture's shutter rolls. The result
    has ``image`` [H, W, 3] float32, and ``formation``, what was undone; None where nothing explains the frame
    better than the render as it is. Raises InputError for a frame without a pose.
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
    """Compare a scene with the sharp images of ``reference`` (``images/`` and ``transforms.json``).

    That of a run (of ``stage``, or the last) is compared in the world of its input, without a ``reference``
    with the frames held out; a scene or a scene.ply has to be in the world of the reference. ``means`` of
    the result maps metrics to figures. Raises InputError where nothing matches.
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
