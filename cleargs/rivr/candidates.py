"""The candidates of a target frame t (the paper's Table "RIVR candidates"), and the choice between them.

They are the render R_t, the restored frame D_t and the fusion F_t of both. O_t is the raw frame. The primary
scorer decides (MUSIQ in the paper). If the best two of its scores are within a margin, the tie-break scorer
(CLIP-IQA in the paper) decides among the candidates within it. Images are [H, W, 3] float32 sRGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from cleargs.types import ArrayF64, ImageF32

CandidateName: TypeAlias = Literal["render", "restored", "fused"]
Chosen: TypeAlias = Literal["render", "restored", "fused", "observed"]
"""A candidate, or the raw frame O_t if it needs no repair."""

Source: TypeAlias = Literal["observation", "deblurred", "render"]
"""Image that the expert restored to D_t: O_t, O_t without the camera's motion, or R_t."""

CANDIDATES: tuple[CandidateName, ...] = ("render", "restored", "fused")
"""R_t, D_t and F_t; in a perfect tie the earlier one is chosen."""

NEGLIGIBLE = 0.15
"""Squared change by a repair, over the squared error of the render, below which there is nothing to repair
(docs/experiments/rivr.md)."""

EXPLAINED = "explained: "
"""Prefix of the reason in a row whose frame image formation explains."""

KEPT = "needs no repair"
"""Reason in a row whose raw frame is kept."""


def fuse(render: ImageF32, restored: ImageF32, sigma: float) -> ImageF32:
    """Return F = clip(R + D - blur_sigma(D)): the render's base with the restored image's fine detail.

    ``sigma`` is the standard deviation of the Gaussian, px. Finer detail comes from ``restored``.
    """
    detail = restored - gaussian_blur(restored, sigma)  # float64
    return np.clip(render + detail, 0.0, 1.0).astype(np.float32)


def gaussian_blur(image: ImageF32, sigma: float) -> ArrayF64:
    """Blur ``image`` [H, W, 3] by a Gaussian cut at 3 sigma, mirrored at the borders, in float64."""
    from scipy.ndimage import gaussian_filter

    radius = max(1, int(np.ceil(3.0 * sigma)))
    blurred = gaussian_filter(image, sigma, mode="reflect", radius=radius, axes=(0, 1), output=np.float64)
    return np.asarray(blurred, np.float64)


@dataclass(frozen=True)
class CandidateChoice:
    """The chosen candidate and the reason."""

    chosen: CandidateName
    reason: str


def choose(
    primary: Mapping[CandidateName, float], tiebreak: Mapping[CandidateName, float], margin: float
) -> CandidateChoice:
    """Choose the candidate with the highest primary score; the tie-break decides within ``margin``.

    If tie-break scores are equal, the higher primary score wins, then the order of `CANDIDATES`. ValueError
    is raised if a score is not finite.
    """
    if not np.isfinite([*primary.values(), *tiebreak.values()]).all():
        raise ValueError(f"scores must be finite: primary {dict(primary)}, tie-break {dict(tiebreak)}")
    best = max(primary.values())
    close = [name for name in CANDIDATES if name in primary and best - primary[name] <= margin]
    if len(close) == 1:
        return CandidateChoice(close[0], "primary score")
    chosen = max(close, key=lambda name: (tiebreak[name], primary[name]))
    return CandidateChoice(chosen, "tie-break among " + ", ".join(close))


def unbeaten(raw: float, candidates: Mapping[CandidateName, float], margin: float) -> bool:
    """Return True if no candidate's score exceeds that of the raw frame by more than ``margin``."""
    return max(candidates.values()) - raw <= margin


def is_negligible_change(observed: ImageF32, restored: ImageF32, render: ImageF32) -> bool:
    """Return True if the repair changes little of the raw frame: |D - O|^2 < 0.15 |R - O|^2.

    A blurred or skewed frame differs from a good scene's render by the blur or the skew, and its repair
    removes much of that. In a sharp frame the difference is an error of the scene, and a repair that follows
    it only carries the error into the frame. Scores do not separate the two, since sharpening raises them in
    both. D and R equal O where the frame is masked.
    """
    changed, unexplained = (
        float(np.square(image - observed, dtype=np.float64).sum()) for image in (restored, render)
    )
    return changed < NEGLIGIBLE * unexplained


def hide_masked(image: ImageF32, observed: ImageF32, mask: np.ndarray | None) -> ImageF32:
    """Return a candidate with the observation O_t where ``mask`` [H, W] is False; None: nothing is masked.

    All candidates then agree there, so that masked pixels cannot decide between them.
    """
    return image if mask is None else np.where(mask[..., None], image, observed)
