"""The Python API: scores and restorations of images, without a run.

Images are [H, W, 3] sRGB, uint8 or float32 in [0, 1]. ``threads`` is the number of threads (default: all
usable cores).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cleargs.errors import InputError
from cleargs.packed import require_images
from cleargs.pipeline.config import check_document
from cleargs.pipeline.session import usable_cores
from cleargs.pipeline.stages import installed
from cleargs.progress import Progress, reporter_of
from cleargs.run_results import Run, open_prepared

if TYPE_CHECKING:
    import pyarrow as pa

    from cleargs.scene.viewer import Deblurred
    from cleargs.types import AnyImage, ImageF32


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
        StoreError: if a file cannot be read.

    Example:
        from pathlib import Path

        paths = sorted(Path("room/images").iterdir())
        table = cg.score_frames(paths)
        print(table.sort_by("R").select(["path", "R", "B"]).slice(0, 3))
    """
    import pyarrow as pa

    from cleargs.rva.allocation import appearance_scores
    from cleargs.rva.evaluator import EvaluatedFrame, evaluated
    from cleargs.rva.evaluators import make_evaluator
    from cleargs.rva.tables import CUE_COLUMNS

    config: Any = check_document(installed(), {"rva": {"evaluator": evaluator}}).sections["rva"]
    with tempfile.TemporaryDirectory() as cache:
        views = [EvaluatedFrame(number, Path(path)) for number, path in enumerate(paths)]
        cues = evaluated(
            make_evaluator(config, cache=Path(cache)),
            views,
            threads=threads or usable_cores(),
            reporter=reporter_of(progress),
        )
    R, B = appearance_scores(cues, config)
    columns = dict(zip(CUE_COLUMNS, cues.T, strict=True))
    return pa.table({"path": [str(path) for path in paths], **columns, "R": R, "B": B})


def score(image: AnyImage, *, scorer: str = "clarity-net", threads: int | None = None) -> float:
    """Rate the quality of an image without a reference, from 0 to 100 (higher is better).

    ``scorer`` is clarity-net, naturalness-stats, an installed model (``cleargs models list``) or an ONNX
    file. Raises InputError if it is unknown, or if the image is smaller than 32 pixels.

    Example:
        import numpy as np

        image = np.random.default_rng(0).random((64, 96, 3), np.float32)
        print(cg.score(image))
    """
    from cleargs.media.image import to_float32
    from cleargs.models.scorer import load_scorer

    return load_scorer(scorer).score(to_float32(image), threads=threads or usable_cores())


def restore(image: AnyImage, *, expert: str = "embedded", threads: int | None = None) -> ImageF32:
    """Restore a degraded image with a neural network. Return float32 in [0, 1] of the same size.

    ``expert`` is embedded, an installed model (``cleargs models list``) or an ONNX file. Raises InputError if
    it is unknown.

    Example:
        import numpy as np

        image = np.random.default_rng(0).random((64, 96, 3), np.float32)
        print(cg.score(cg.restore(image)))
    """
    from cleargs.media.image import to_float32
    from cleargs.models.expert import load_expert

    return load_expert(expert).restore(to_float32(image), threads=threads or usable_cores())


def deblur(run: Run, frame_id: int, *, stage: str | None = None) -> Deblurred | None:
    """Remove motion blur, rolling shutter and defocus from a frame image, as fitted by a trained scene.

    Rolling shutter is removed only if the training detected it in the capture. ``stage`` is the stage that
    trained the scene (default: the last one that has a scene). Raises InputError if the frame has no pose.

    Returns:
        ``image`` [H, W, 3], float32 sRGB in [0, 1], and ``formation``, the effects that were removed. None if
        no effect explains the frame better than the sharp render.

    Example:
        deblurred = cg.deblur(cg.open_run("run"), 3)
        if deblurred is not None:
            print(deblurred.formation.blur_px, deblurred.image.shape)
    """
    from cleargs.scene.viewer import SceneViewer
    from cleargs.scene.views import view_of

    require_images(run.folder, "deblurring")
    capture = open_prepared(run["ingest"])
    frame = next((frame for frame in capture.frames if frame.frame_id == frame_id), None)
    if frame is None or not frame.registered:
        raise InputError(f"frame {frame_id} has no pose", hint="see cleargs show RUN ingest")
    return SceneViewer(run.scene_file(stage).parent).deblur(view_of(frame, capture.folder, 1.0))
