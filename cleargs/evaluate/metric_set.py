"""The metrics of an evaluation, learned ones included; those that are not installed are named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cleargs.evaluate.config import INSTALLABLE, EvalOptions
from cleargs.evaluate.metrics import Mask, Pixels, psnr, ssim
from cleargs.models.lpips import Lpips, weights_file
from cleargs.models.registry import file_digest, model_dir
from cleargs.models.scorer import Scorer, load_scorer

Image = NDArray[np.float32]


@dataclass(frozen=True)
class MetricSet:
    """The metrics of an evaluation, ready to be asked from several threads at once."""

    lpips: Mapping[str, Callable[[Image, Image], float]]
    """Metric -> distance of two float32 sRGB images."""
    scorers: Mapping[str, Scorer]
    weights: Mapping[str, str]
    """Metric -> digest of its weights."""
    unavailable: Mapping[str, str]
    """Metric -> why it cannot be had."""

    def measure(
        self,
        image: Pixels,  # [H, W, 3]
        reference: Pixels,  # [H, W, 3]
        mask: Mask | None,  # [H, W] True = counts
    ) -> dict[str, float | None]:
        """All metrics of an image; those that cannot be had are None.

        LPIPS sees the reference's own pixels where the mask ignores the image's. Scorers, which know no
        masks, see the whole image.
        """
        values = {"psnr": psnr(image, reference, mask), "ssim": ssim(image, reference, mask)}
        seen = image if mask is None else np.where(mask[..., None], image, reference)
        for name, distance in self.lpips.items():
            values[name] = distance(_floats(seen), _floats(reference))
        for name, scorer in self.scorers.items():
            values[name] = scorer.score(_floats(image))
        return values | dict.fromkeys(self.unavailable)


def load_metrics(options: EvalOptions) -> MetricSet:
    """Load what ``options`` asks for. Weights that a user installs may be absent: their metrics will be null.

    Raises InputError for a scorer of an unknown name or an unusable file.
    """
    lpips: dict[str, Callable[[Image, Image], float]] = {}
    scorers: dict[str, Scorer] = {}
    weights: dict[str, str] = {}
    unavailable: dict[str, str] = {}
    for net in options.lpips:
        file = model_dir() / weights_file(net)
        if file.is_file():
            lpips[f"lpips_{net}"] = Lpips(net).distance
            weights[f"lpips_{net}"] = file_digest(file)
        else:
            unavailable[f"lpips_{net}"] = "not installed: run `cleargs models install lpips` once"
    for name in options.scorers:
        scorer = _scorer(name)
        if scorer is not None:
            scorers[name] = scorer
            weights[name] = scorer.digest
        else:
            unavailable[name] = "not installed: see `cleargs models list`"
    return MetricSet(lpips, scorers, weights, unavailable)


def _scorer(name: str) -> Scorer | None:
    """The scorer of that name; None for one of `INSTALLABLE` that the user has not installed."""
    if name in INSTALLABLE and not (model_dir() / f"{name}.onnx").is_file():
        return None
    return load_scorer(name)


def _floats(image: Pixels) -> Image:
    return image.astype(np.float32) / np.float32(255)
