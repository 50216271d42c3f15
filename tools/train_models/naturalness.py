"""Fit the statistics scorer to the pairs of ``train_scorer``.

    python -m tools.train_models.naturalness --work DIR --out cleargs/models/naturalness.toml

The fit is a ridge regression of LPIPS on the terms of a quadratic. It also fits the differences to the clean
version of the same content, because RIVR only compares versions of one content. The features take minutes,
the fit seconds.
"""

from __future__ import annotations

from pathlib import Path

import click
import cv2
import numpy as np
import tomli_w
from numpy.typing import NDArray

from cleargs.models.naturalness import Quadratic, features, terms
from tools.train_models.scorer_pairs import Pairs, load_pairs
from tools.train_models.train_scorer import report

_RIDGE = 100.0
_DIFFERENCES = 1.0  # weight of the differences to the clean version


def pair_features(pairs: Pairs) -> NDArray[np.float64]:
    """Return the features of every version [G, V, F]."""
    return np.stack([[features(v.astype(np.float32) / np.float32(255.0)) for v in g] for g in pairs.images])


def fit(
    figures: NDArray[np.float64],  # [G, V, F]
    targets: NDArray[np.float32],  # [G, V] LPIPS to version 0
) -> Quadratic:
    """Return the ridge solution, rounded to seven digits."""
    mean, deviation = figures.mean(axis=(0, 1)), figures.std(axis=(0, 1))
    design = terms(figures, mean, deviation)
    steps = (design[:, 1:] - design[:, :1]).reshape(-1, design.shape[-1])
    rises = (targets[:, 1:] - targets[:, :1]).ravel()
    rows, wanted = design.reshape(-1, design.shape[-1]), targets.ravel()
    normal = rows.T @ rows + _DIFFERENCES * steps.T @ steps + _RIDGE * np.eye(rows.shape[1])
    weights = np.linalg.solve(normal, rows.T @ wanted + _DIFFERENCES * steps.T @ rises)
    return Quadratic(mean=_rounded(mean), deviation=_rounded(deviation), weights=_rounded(weights))


def _rounded(values: NDArray[np.floating]) -> tuple[float, ...]:
    return tuple(float(f"{value:.7g}") for value in values)


@click.command()
@click.option("--work", type=click.Path(exists=True, file_okay=False, path_type=Path), required=True)
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), required=True)
def main(work: Path, out: Path) -> None:
    """Fit, print a report on the held-out photo sources, and write the coefficients."""
    cv2.setNumThreads(1)
    pairs, test = load_pairs(work / "train"), load_pairs(work / "held")
    model = fit(pair_features(pairs), pairs.targets)
    predicted = np.apply_along_axis(model, -1, pair_features(test)).astype(np.float32)
    click.echo("\n".join(report(predicted, test)))
    out.write_text(
        "# Written by tools.train_models.naturalness.\n" + tomli_w.dumps(model.model_dump()), "utf-8"
    )


if __name__ == "__main__":
    main()
