"""A training whose result is a scene folder: of G0, of a group of repairs, or of the consolidation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cleargs.formation.capture import CaptureFormation
from cleargs.formation.exposure import Exposure
from cleargs.memory import release_freed
from cleargs.progress import Reporter
from cleargs.scene.dust import Dusted, without_dust
from cleargs.scene.folder import SceneFolder
from cleargs.splat.config import TrainConfig
from cleargs.splat.scene import Scene
from cleargs.splat.trainer import Trainer
from cleargs.splat.training import run
from cleargs.splat.views import TrainingView
from cleargs.timing import timed


def train_into(
    folder: Path,
    scene: Scene,
    views: Sequence[TrainingView],
    config: TrainConfig,
    formation: CaptureFormation,
    *,
    exposure: Exposure,  # that is written if exposure compensation is off
    checkpoint: Path,
    reporter: Reporter,
    label: str,
    device: str,
    round: int = 0,
    dust: bool = True,  # remove the dust of the scene
    **options: Any,  # for `Trainer`
) -> Dusted:
    """Train a scene, remove its dust and write the files of `SceneFolder` into ``folder``."""
    trained = run(
        Trainer(scene, views, config, formation=formation, device=device, **options),  # freed after it
        checkpoint=checkpoint,
        reporter=reporter,
        label=label,
        round=round,
    )
    release_freed()
    learned = formation.exposure or exposure
    dusted = Dusted(trained, 0, 0, [], [])
    if dust:
        with timed("removing dust"):
            dusted = without_dust(trained, views, learned, formation.frames, formation.moving, device)
    weights = {view.frame_id: view.weight for view in views if view.kind == "real"}
    with timed("writing the scene"):
        SceneFolder(folder).write(dusted.trained, learned, formation, weights)
    return dusted
