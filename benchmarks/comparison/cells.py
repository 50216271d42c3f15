"""Cells of a comparison, and their means, spreads and paired differences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

from cleargs.evaluate.eval_report import LOWER_IS_BETTER, Figures

ViewSet = Literal["observed", "given", "novel", "held-out", "reference"]
"""Views on which a scene is evaluated.

* ``observed``: sharp truth at the true poses of the frames.
* ``given``: sharp truth of the same frames, rendered at the noisy poses of the capture.
* ``novel``: sharp truth at poses off the camera path.
* ``held-out``: test frames.
* ``reference``: images that the user gave.
"""


class Cell(Figures):
    """One scene, evaluated on one set of views."""

    column: str
    """Column of the tables: the protocol of a synthetic capture, or the name of a real one."""
    sample: str
    """Capture and seed. Differences between variants are taken within one sample."""
    variant: str
    views: ViewSet
    means: dict[str, float | None]
    """Metric -> mean over the images; None if it could not be measured."""
    images: int
    trained_on: int | None = None
    """Number of images that show frames of the training; None if unknown."""
    seconds: float
    """Wall time of the stages that ran first for this variant."""
    shared_seconds: float
    """Wall time of the stages that an earlier variant of the sample had finished."""
    gaussians: int
    steps: int
    """Training steps of all stages that lead to the scene, from their logs."""
    sh_degree: int
    cpu_seconds: float | None
    """Processor time of all stages that lead to the scene, shared ones included; None if unknown."""
    peak_memory_gb: float | None
    """Largest resident memory of these stages, GB (1e9 bytes)."""
    evaluation: str
    """Folder with ``eval.json`` and the rendered images, relative to the folder of the comparison."""


@dataclass(frozen=True)
class Spread:
    """Mean and sample standard deviation of some values; the deviation is None for a single value."""

    mean: float
    deviation: float | None
    count: int

    @property
    def half_width(self) -> float | None:
        """Half the 95 % interval of the mean (Student's t); None for a single value."""
        if self.deviation is None:
            return None
        return student_t(self.count - 1) * self.deviation / math.sqrt(self.count)

    @property
    def includes_zero(self) -> bool:
        """True if the 95 % interval of a mean difference includes 0."""
        return self.half_width is not None and abs(self.mean) <= self.half_width

    @property
    def excludes_zero(self) -> bool:
        """True if there is an interval and it excludes 0: the difference is significant."""
        return self.half_width is not None and not self.includes_zero


@cache
def student_t(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t with ``freedom`` degrees of freedom."""
    from scipy.stats import t

    return float(t.ppf(0.975, freedom))


def spread(values: Sequence[float]) -> Spread:
    """Return the spread of at least one value. The mean is infinite if a value is (PSNR of equal images)."""
    mean = math.fsum(values) / len(values)
    if len(values) < 2:
        return Spread(mean, None, len(values))
    variance = math.fsum((value - mean) ** 2 for value in values) / (len(values) - 1)
    return Spread(mean, math.sqrt(variance), len(values))


class Cells:
    """Queries on a list of cells; results keep the order of the cells."""

    def __init__(self, cells: Iterable[Cell]) -> None:
        self.cells = tuple(cells)

    def view_sets(self) -> list[ViewSet]:
        return list(dict.fromkeys(cell.views for cell in self.cells))

    def variants(self) -> list[str]:
        return list(dict.fromkeys(cell.variant for cell in self.cells))

    def columns(self, views: ViewSet) -> list[str]:
        return list(dict.fromkeys(cell.column for cell in self.cells if cell.views == views))

    def metrics(self) -> list[str]:
        """Return the metrics for which at least one cell has a value."""
        return list(
            dict.fromkeys(
                name for cell in self.cells for name, value in cell.means.items() if value is not None
            )
        )

    def values(self, views: ViewSet, column: str, variant: str, metric: str) -> dict[str, float]:
        """Return a value for each sample that has one."""
        return {
            cell.sample: value
            for cell in self.of(views, column, variant)
            if (value := cell.means.get(metric)) is not None
        }

    def of(self, views: ViewSet, column: str, variant: str) -> list[Cell]:
        """Return the cells of all samples."""
        wanted = (views, column, variant)
        return [cell for cell in self.cells if (cell.views, cell.column, cell.variant) == wanted]

    def spread(self, views: ViewSet, column: str, variant: str, metric: str) -> Spread | None:
        """Return the spread over the samples; None without a value."""
        values = list(self.values(views, column, variant, metric).values())
        return spread(values) if values else None

    def difference(
        self, views: ViewSet, column: str, variant: str, baseline: str, metric: str
    ) -> Spread | None:
        """Return the spread of ``variant`` minus ``baseline`` over their common samples; None without one."""
        ours = self.values(views, column, variant, metric)
        theirs = self.values(views, column, baseline, metric)
        pairs = [ours[sample] - theirs[sample] for sample in ours if sample in theirs]
        return spread(pairs) if pairs else None

    def best(self, views: ViewSet, column: str, metric: str) -> str | None:
        """Return the variant with the best mean; None without a value.

        Only variants with the largest number of samples count: means over different samples are not
        comparable.
        """
        spreads = {
            variant: found
            for variant in self.variants()
            if (found := self.spread(views, column, variant, metric)) is not None
        }
        most = max((found.count for found in spreads.values()), default=0)
        means = {variant: found.mean for variant, found in spreads.items() if found.count == most}
        if not means:
            return None
        pick = min if metric in LOWER_IS_BETTER else max
        return pick(means, key=lambda variant: means[variant])
