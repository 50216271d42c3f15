"""An evaluator: rva.evaluator=contrast rates sharpness and motion blur by the contrast of fine detail."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.media.image import read_rgb
from cleargs.progress import Reporter
from cleargs.rva.evaluator import EvaluatedFrame
from cleargs.rva.tables import CUE_COLUMNS


class ContrastEvaluator:
    """Created once per run. ``cache`` is a folder for results of single frames, or None."""

    name, version = "contrast", 1

    def __init__(self, *, seed: int, device: str, cache: Path | None) -> None: ...

    def evaluate(
        self, views: Sequence[EvaluatedFrame], *, threads: int, reporter: Reporter
    ) -> NDArray[np.float64]:  # [n, 11] in [0, 1]
        detail = np.array([self._detail(view) for view in views])
        sharp = detail / max(detail.max(initial=0.0), 1e-9)
        good = [name.startswith("r_") for name in CUE_COLUMNS]
        cues = np.tile(np.where(good, 1.0, 0.0), (len(views), 1))  # other cues get the best value
        cues[:, CUE_COLUMNS.index("r_sharpness")] = sharp
        cues[:, CUE_COLUMNS.index("b_motion_blur")] = 1.0 - sharp
        return cues

    def _detail(self, view: EvaluatedFrame) -> float:
        grey = cv2.cvtColor(read_rgb(view.image), cv2.COLOR_RGB2GRAY)
        return float(cv2.Laplacian(grey, cv2.CV_64F).std())
