"""The Python API: scenes and trainings, without a run."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cleargs.errors import InputError
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.stages import installed
from cleargs.progress import PREVIEW, Progress, reporter_of
from cleargs.run_results import Prepared
from cleargs.splat.budget import resolve_config

if TYPE_CHECKING:
    from cleargs import G0Config
    from cleargs.splat.camera import Camera
    from cleargs.splat.config import TrainConfig
    from cleargs.splat.formation import Formation
    from cleargs.splat.scene import Scene
    from cleargs.splat.training import Trained
    from cleargs.splat.types import Render
    from cleargs.splat.views import TrainingView


def initialise(
    capture: Prepared,
    views: Sequence[TrainingView] | None = None,
    config: G0Config | None = None,
    *,
    seed: int = 0,
) -> Scene:
    """Return a scene to start a training from: one Gaussian per sparse point, and more between them.

    ``views`` give the added Gaussians their depths and colours (default: all of ``capture``). In ``config``,
    only ``sh_degree``, ``min_points``, ``budget``, ``quality``, ``antialias`` and ``background`` have an
    effect.

    Example:
        capture = cg.open_prepared(cg.open_run("run")["ingest"])
        scene = cg.initialise(capture, config=cg.G0Config(sh_degree=1))
    """
    from cleargs import G0Config
    from cleargs.scene.views import seen_points
    from cleargs.splat.initialise import starting_gaussians
    from cleargs.splat.scene import BLACK, Scene

    views = capture.views() if views is None else views
    config = resolve_config(config or G0Config(), views)
    sparse = seen_points(capture.points, capture.folder, views)
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
        InputError: if no view has a weight above 0, or if ``checkpoint`` is a file of another kind.

    Example:
        capture = cg.open_prepared(cg.open_run("run")["ingest"])
        start = cg.initialise(capture)
        trained = cg.train(start, capture.views(), cg.TrainConfig(steps=20))
        print(trained.rows["loss"][-1])
    """
    from cleargs.splat.config import TrainConfig
    from cleargs.splat.state import load_state
    from cleargs.splat.trainer import Trainer
    from cleargs.splat.training import run

    config = config or TrainConfig()
    if checkpoint is not None:
        check_outputs([Path(checkpoint), Path(checkpoint).with_name(PREVIEW)], installed())
        state = load_state(Path(checkpoint), reporter_of(progress))
        if Path(checkpoint).exists() and (state is None or "fingerprint" not in state):
            raise InputError(f"{checkpoint} exists and is not a checkpoint", hint="choose another name")
    with tempfile.TemporaryDirectory() as nowhere:
        if checkpoint is None:  # the interval is longer than any training: no checkpoint is written
            config = config.model_copy(update={"checkpoint_interval": 1_000_000})
        trainer = Trainer(scene, views, config, seed=(seed,), formation=formation, device=device)
        return run(
            trainer,
            checkpoint=Path(nowhere) / "none" if checkpoint is None else Path(checkpoint),
            reporter=reporter_of(progress),
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
        InputError: for another ending, or for a file of a run.

    Example:
        cg.save(cg.open_run("run").scene(), "room.spz")
    """
    from cleargs.splat.formats import format_of, write_scene

    check_outputs([Path(path)], installed())
    write_scene(Path(path), scene, format_of(Path(path)))


def load(path: str | Path) -> Scene:
    """Read a scene file of any program: .ply, .compressed.ply, .sog, .spz, .glb, .usdc.

    Raises:
        StoreError: if the file cannot be read.

    Example:
        scene = cg.load("run/g0/scene.ply")
        print(scene.gaussians.num)
    """
    from cleargs.splat.formats import read_scene

    return read_scene(Path(path))
