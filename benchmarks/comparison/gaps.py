"""Find the cells in which one variant of a comparison is worse than another."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from benchmarks.comparison.cells import Cells, Spread, ViewSet
from benchmarks.comparison.tables import COMPARED, NAMES, Bold, Table, difference_text
from cleargs.evaluate.eval_report import LOWER_IS_BETTER

SIGNIFICANCE = ("significant", "one sample", "none")
"""Significance of a difference: its 95 % interval excludes 0, there is no interval, or it includes 0."""


@dataclass(frozen=True)
class Gap:
    """Difference between two variants in one cell: value of the variant minus that of ``against``."""

    views: ViewSet
    column: str
    against: str
    metric: str
    difference: Spread

    @property
    def significance(self) -> str:
        """One of `SIGNIFICANCE`."""
        if self.difference.half_width is None:
            return "one sample"
        return "significant" if self.difference.excludes_zero else "none"


def compared_with(cells: Cells, variant: str) -> Iterator[Gap]:
    """Compare ``variant`` with every other one, in every column and metric of `COMPARED`."""
    for views in cells.view_sets():
        for column in cells.columns(views):
            for other in cells.variants():
                for metric in COMPARED:
                    difference = cells.difference(views, column, variant, other, metric)
                    if other != variant and difference is not None:
                        yield Gap(views, column, other, metric, difference)


def losses_of(cells: Cells, variant: str) -> list[Gap]:
    """Return the cells in which ``variant`` is worse, significant differences first."""
    found = [loss for loss in compared_with(cells, variant) if is_worse(loss.difference, loss.metric)]
    return sorted(found, key=lambda loss: SIGNIFICANCE.index(loss.significance))


def is_worse(difference: Spread, metric: str) -> bool:
    """Return True if the mean difference means a worse metric."""
    return difference.mean > 0 if metric in LOWER_IS_BETTER else difference.mean < 0


def losses_table(places: Sequence[str], found: Iterable[tuple[tuple[str, ...], Gap]]) -> Table:
    """Return a table of losses with one column per metric; significant losses are bold.

    Args:
        places: Headings of the columns that name the place of a loss.
        found: Losses with the texts of these columns. Losses of one place share a row.
    """
    rows: dict[tuple[str, ...], list[str]] = {}
    for place, loss in found:
        text = difference_text(loss.difference, None, loss.metric)
        row = rows.setdefault(place, [""] * len(COMPARED))
        row[COMPARED.index(loss.metric)] = Bold(text) if loss.significance == "significant" else text
    return Table(
        [*places, *(NAMES[metric] for metric in COMPARED)], [[*place, *row] for place, row in rows.items()]
    )
