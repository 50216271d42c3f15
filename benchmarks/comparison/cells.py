"""Cells of a comparison and what is read off them: means, spreads, paired differences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

from cleargs.evaluate.eval_report import LOWER_IS_BETTER, Figures

ViewSet = Literal["observed", "given", "novel", "held-out", "reference"]
"""Where a scene is judged: sharp truth at the input's true poses, the same at the poses as given (where the
capture's are noisy), sharp truth off the path, test frames, or the user's own reference."""


class Cell(Figures):
    """One scene judged on one set of views."""

    column: str
    """What is compared across: the protocol of a synthetic capture, else the capture's name."""
    sample: str
    """Which capture and seed of the column; differences are taken within one sample."""
    variant: str
    views: ViewSet
    means: dict[str, float | None]
    """Metric -> mean over the images; None where it could not be measured."""
    images: int
    trained_on: int | None = None
    """How many of them show frames that the scene was trained on; None where that is not known."""
    seconds: float
    """Wall time of the stages that no earlier variant of the sample had made."""
    shared_seconds: float
    """Wall time of the stages that it shares with earlier variants."""
    gaussians: int
    steps: int
    """Training steps of all stages behind the scene, as logged."""
    sh_degree: int
    cpu_seconds: float | None
    """Processor time of all stages behind the scene, shared ones included; None where it was not noted."""
    peak_memory_gb: float | None
    """Largest resident memory of any of them, GB (1e9 bytes)."""
    evaluation: str
    """Folder below that of the comparison: ``eval.json`` and the evaluated images."""


@dataclass(frozen=True)
class Spread:
    """Mean and sample standard deviation; the deviation is None for a single value."""

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
    def is_none(self) -> bool:
        """Whether the 95 % interval of a mean difference holds 0."""
        return self.half_width is not None and abs(self.mean) <= self.half_width

    @property
    def is_sure(self) -> bool:
        """Whether there is an interval and it does not hold 0."""
        return self.half_width is not None and not self.is_none


@cache
def student_t(freedom: int) -> float:
    """The 97.5 % quantile of Student's t with so many degrees of freedom."""
    from scipy.stats import t

    return float(t.ppf(0.975, freedom))


def spread(values: Sequence[float]) -> Spread:
    """The spread of one or more values; infinite ones (PSNR of equal images) make it infinite."""
    mean = math.fsum(values) / len(values)
    if len(values) < 2:
        return Spread(mean, None, len(values))
    variance = math.fsum((value - mean) ** 2 for value in values) / (len(values) - 1)
    return Spread(mean, math.sqrt(variance), len(values))


class Cells:
    """Look-ups over a set of cells, in their order."""

    def __init__(self, cells: Iterable[Cell]) -> None:
        self.cells = tuple(cells)

    def view_sets(self) -> list[ViewSet]:
        return list(dict.fromkeys(cell.views for cell in self.cells))

    def variants(self) -> list[str]:
        return list(dict.fromkeys(cell.variant for cell in self.cells))

    def columns(self, views: ViewSet) -> list[str]:
        return list(dict.fromkeys(cell.column for cell in self.cells if cell.views == views))

    def metrics(self) -> list[str]:
        """Metrics that at least one cell has a value for."""
        return list(
            dict.fromkeys(
                name for cell in self.cells for name, value in cell.means.items() if value is not None
            )
        )

    def values(self, views: ViewSet, column: str, variant: str, metric: str) -> dict[str, float]:
        """Sample -> value."""
        return {
            cell.sample: value
            for cell in self.of(views, column, variant)
            if (value := cell.means.get(metric)) is not None
        }

    def of(self, views: ViewSet, column: str, variant: str) -> list[Cell]:
        """The cells of all samples."""
        wanted = (views, column, variant)
        return [cell for cell in self.cells if (cell.views, cell.column, cell.variant) == wanted]

    def spread(self, views: ViewSet, column: str, variant: str, metric: str) -> Spread | None:
        """Over the samples; None where there is no value."""
        values = list(self.values(views, column, variant, metric).values())
        return spread(values) if values else None

    def difference(
        self, views: ViewSet, column: str, variant: str, baseline: str, metric: str
    ) -> Spread | None:
        """``variant`` minus ``baseline``, paired within the samples that have both; None without one."""
        ours = self.values(views, column, variant, metric)
        theirs = self.values(views, column, baseline, metric)
        pairs = [ours[sample] - theirs[sample] for sample in ours if sample in theirs]
        return spread(pairs) if pairs else None

    def best(self, views: ViewSet, column: str, metric: str) -> str | None:
        """The variant with the best mean, of those that were measured on the most samples: means over
        other samples say nothing of each other.
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
