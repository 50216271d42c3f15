"""Measure how well the embedded scorers agree with LPIPS on held-out photo sources.

    python -m tools.train_models.evaluate_scorer --photos DIR

The photos are whole, reduced by a third, with each artefact once. The script needs the LPIPS weights
(`cleargs models install lpips`).
"""

from __future__ import annotations

from pathlib import Path

import click
import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.models.lpips import load_lpips
from cleargs.models.scorer import CLARITY, NATURALNESS, load_scorer
from cleargs.types import ImageF32
from tools.train_models import artefacts
from tools.train_models.degrade import Degradation, degrade, motion_kernel
from tools.train_models.train_restorer import list_photos, read_photo
from tools.train_models.train_scorer import spearman

_VISIBLE = 0.02  # LPIPS above which an artefact counts as visible
_REDUCTION = 0.67


def candidates(image: ImageF32, rng: np.random.Generator) -> dict[str, ImageF32]:
    """Return the clean image and candidates like those of RIVR: blurred, sharpened, deconvolved, splatted."""
    kernel = motion_kernel(rng, rng.uniform(4.0, 12.0))
    blurred = degrade(image, Degradation(kernel, noise=0.5 / 255.0), rng)
    return {
        "clean": image,
        "blurred": blurred,
        "blurred, then Wiener": artefacts.wiener(blurred, kernel, 0.01),
        "unsharp 1 px x 1": artefacts.unsharp(image, 1.0, 1.0),
        "unsharp 1.5 px x 3": artefacts.unsharp(image, 1.5, 3.0),
        "Gibbs ringing": artefacts.gibbs(image, 0.25, 1.8),
        "splats": artefacts.splat(image, rng, 3.0, 4.0),
    }


def agreement(
    scores: NDArray[np.float64],  # [P, K] one photo per row, version 0 clean
    distances: NDArray[np.float64],  # [P, K] LPIPS to version 0
    names: list[str],  # [K]
) -> list[str]:
    """Return a Markdown table by artefact: agreement with -LPIPS, share of clean photos that score higher."""
    within = [spearman(s, -d) for s, d in zip(scores, distances, strict=True)]
    lines = [
        f"Spearman with -LPIPS: {spearman(scores, -distances):.3f} over all images, "
        f"{np.mean(within):.3f} among the versions of one photo (mean)",
        "",
        f"| artefact | mean LPIPS | Spearman | clean preferred | where LPIPS >= {_VISIBLE} |",
        "|---|---|---|---|---|",
    ]
    for k, name in enumerate(names[1:], start=1):
        preferred = scores[:, 0] > scores[:, k]
        visible = distances[:, k] >= _VISIBLE
        lines.append(
            f"| {name} | {distances[:, k].mean():.3f} | {spearman(scores[:, k], -distances[:, k]):.2f} "
            f"| {preferred.mean():.0%} | {preferred[visible].mean():.0%} of {visible.sum()} |"
        )
    return lines


def choices(scores: NDArray[np.float64], names: list[str]) -> list[str]:
    """Return a Markdown table of scores [P, K]: mean, share below clean, share above blurred."""
    lines = ["| candidate | mean score | below clean | above blurred |", "|---|---|---|---|"]
    blurred = scores[:, names.index("blurred")]
    for k, name in enumerate(names):
        own, clean = scores[:, k], scores[:, 0]
        lines.append(
            f"| {name} | {own.mean():.1f} | {(own < clean).mean():.0%} | {(own > blurred).mean():.0%} |"
        )
    return lines


def _photo(path: Path) -> ImageF32:
    image = cv2.resize(read_photo(path), None, fx=_REDUCTION, fy=_REDUCTION, interpolation=cv2.INTER_AREA)
    return image.astype(np.float32) / np.float32(255.0)


@click.command()
@click.option("--photos", type=click.Path(exists=True, file_okay=False, path_type=Path), required=True)
@click.option("--models", type=click.Path(path_type=Path), default=None, help="Folder of installed models.")
@click.option("--seed", default=2001, show_default=True)
def main(photos: Path, models: Path | None, seed: int) -> None:
    """Print the tables of both embedded scorers."""
    cv2.setNumThreads(1)
    lpips = load_lpips("alex", models)
    scorers = [load_scorer(CLARITY), load_scorer(NATURALNESS)]
    held = [_photo(path) for path in list_photos(photos, held_out=True)]
    distances, scores, offered = [], [], []
    for index, photo in enumerate(held):
        rng = np.random.default_rng([seed, index])
        versions = [make(photo, rng) for make in artefacts.KINDS.values()]
        distances.append([lpips.distance(photo, version) for version in versions])
        scores.append([[scorer.score(version) for version in versions] for scorer in scorers])
        rivals = candidates(photo, rng)
        offered.append([[scorer.score(rival) for rival in rivals.values()] for scorer in scorers])
    for n, scorer in enumerate(scorers):
        click.echo(f"\n#### {scorer.name}, {len(held)} photos\n")
        click.echo("\n".join(agreement(np.array(scores)[:, n], np.array(distances), list(artefacts.KINDS))))
        click.echo("\n" + "\n".join(choices(np.array(offered)[:, n], list(rivals))))


if __name__ == "__main__":
    main()
