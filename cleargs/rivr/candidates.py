"""The candidates of a target frame t (the paper's Table "RIVR candidates"), and the choice between them.

`CANDIDATES` has one entry for each. O_t is the frame image. Images are [H, W, 3] float32 sRGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from cleargs.errors import InputError, StageError
from cleargs.plugins import load_plugin
from cleargs.types import ArrayF64, ImageF32

Source: TypeAlias = Literal["observed", "deblurred", "render"]
"""Image that the expert restored to D_t: O_t, O_t without the camera's motion, or R_t."""

Scores: TypeAlias = Mapping[str, float]
"""Candidate, or `OBSERVED` -> its score, 0-100, higher is better."""

OBSERVED = "observed"
"""Name of the frame image O_t among the choices and the layers of an EXR."""


class Materials(NamedTuple):
    """The images that a candidate may be made from, as read back from the EXR."""

    render: ImageF32
    """R_t."""
    restored: ImageF32
    """D_t."""
    observed: ImageF32
    """O_t."""
    sigma: float
    """``rivr.fuse_sigma``, px."""


@dataclass(frozen=True)
class Candidate:
    """One kind of repair."""

    label: str
    """Its name on the report's page."""
    phrase: str
    """Its name in a sentence."""
    make: Callable[[Materials], ImageF32]


CANDIDATES: Mapping[str, Candidate] = {
    "render": Candidate("Scene before repair", "the render", lambda images: images.render),
    "restored": Candidate("Restored", "the restored frame", lambda images: images.restored),
    "fused": Candidate(
        "Fused",
        "the fusion of render and restored frame",
        lambda images: fuse(images.render, images.restored, images.sigma),
    ),
}
"""Name, which is also that of the layer in the EXR -> candidate. In a perfect tie the earlier one is chosen.

Render and restored frame are always made, the others if ``rivr.candidates`` names them.
"""

ALWAYS = ("render", "restored")
"""Candidates of every target frame."""

NEGLIGIBLE = 0.15
"""Squared change by a repair, over the squared error of the render, below which there is nothing to repair
(docs/experiments/rivr.md)."""

EXPLAINED = "explained: "
"""Prefix of the reason in a row whose frame image formation explains."""

KEPT = "needs no repair"
"""Reason in a row whose frame image is kept."""

MASKED = "every pixel of the frame is masked"
"""Reason in a row without a usable pixel."""

REFUSED = "repair refused: "
"""Prefix of the reason of a choice if the repair was refused as a candidate."""


def candidate(name: str) -> Candidate:
    """Return the candidate ``name`` of `CANDIDATES` or of another package.

    Raises InputError if no package provides it, or provides something else.
    """
    found = CANDIDATES[name] if name in CANDIDATES else load_plugin("candidates", name)
    if not isinstance(found, Candidate):
        hint = "its entry point must name a cleargs.rivr.candidates.Candidate"
        raise InputError(f"the plugin {name} is not a candidate", hint=hint)
    return found


def made_image(image: ImageF32, like: ImageF32, maker: str) -> ImageF32:
    """Return the ``image`` that ``maker`` made.

    Raises StageError if it is not finite, or not as large as ``like``.
    """
    if np.shape(image) != like.shape or not np.isfinite(image).all():
        raise StageError(
            f"{maker} made an image of {np.shape(image)} in place of a finite one of {like.shape}",
            hint="repair it, or choose another one",
        )
    return image


def phrase_of(chosen: str) -> str:
    """Return the name of a choice in a sentence; of a candidate of another package, its plain name."""
    phrases = {name: known.phrase for name, known in CANDIDATES.items()} | {OBSERVED: "kept as filmed"}
    return phrases.get(chosen, chosen)


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
class Decision:
    """The supervision of a frame."""

    chosen: str
    """A candidate, or `OBSERVED`: the frame image."""
    accepted: bool
    """True if the chosen candidate becomes a pseudo observation."""
    reason: str


def decide(
    primary: Scores,  # scores of the candidates, and of the frame image if it may be kept
    tiebreak: Scores,
    margin: float,
    *,
    masked: bool = False,  # True if no pixel of the frame counts
    explained: str | None = None,  # the effect that explains the frame; None: none does, or not well enough
    negligible: bool = False,  # True if the repair changes so little that an unbeaten frame image is kept
    refused: str | None = None,  # why a gate refuses the restored frame
) -> Decision:
    """Decide what supervises a frame; the first row that holds gives the reason.

    | case | chosen | accepted |
    |---|---|---|
    | masked | as in the rows below | no |
    | explained, and it may be kept | frame image | no |
    | negligible, no score beats the frame image's by more than ``margin`` | frame image | no |
    | refused | render: all other candidates contain the refused repair | yes |
    | else | highest primary score; the tie-break decides within ``margin`` of it | yes |

    If tie-break scores are equal, the higher primary score wins, then the earlier candidate. ValueError is
    raised if a score is not finite.
    """
    if not np.isfinite([*primary.values(), *tiebreak.values()]).all():
        raise ValueError(f"scores must be finite: primary {dict(primary)}, tie-break {dict(tiebreak)}")
    names = [name for name in primary if name != OBSERVED]
    kept = None
    if OBSERVED in primary:
        gains = (scores[name] - scores[OBSERVED] for scores in (primary, tiebreak) for name in names)
        beaten = any(gain > margin for gain in gains)
        kept = f"{EXPLAINED}{explained}" if explained else KEPT if negligible and not beaten else None
    if kept is not None:
        chosen, reason = OBSERVED, kept
    elif refused is not None:
        chosen, reason = "render", f"{REFUSED}{refused}"
    else:
        best = max(primary[name] for name in names)
        close = [name for name in names if best - primary[name] <= margin]
        chosen = max(close, key=lambda name: (tiebreak[name], primary[name]))
        reason = "primary score" if len(close) == 1 else "tie-break among " + ", ".join(close)
    return Decision(chosen, accepted=not masked and kept is None, reason=MASKED if masked else reason)


def is_negligible_change(observed: ImageF32, restored: ImageF32, render: ImageF32) -> bool:
    """Return True if the repair changes little of the frame image: |D - O|^2 < 0.15 |R - O|^2.

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
