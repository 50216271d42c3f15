"""Where one variant of a comparison is behind another."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from benchmarks.comparison.cells import Cells, Spread, ViewSet
from benchmarks.comparison.tables import COMPARED, NAMES, Bold, Table, difference_text
from cleargs.evaluate.eval_report import LOWER_IS_BETTER

VERDICTS = ("sure", "one sample", "none")
"""Whether a difference is one: its 95 % interval does not hold 0, there is no interval, or it holds 0."""


@dataclass(frozen=True)
class Gap:
    """How far a variant is from another in one cell: ``difference`` is its value minus the other's."""

    views: ViewSet
    column: str
    against: str
    metric: str
    difference: Spread

    @property
    def verdict(self) -> str:
        """One of `VERDICTS`."""
        if self.difference.half_width is None:
            return "one sample"
        return "sure" if self.difference.is_sure else "none"


def compared_with(cells: Cells, variant: str) -> Iterator[Gap]:
    """``variant`` against every other, in every column and each of `COMPARED`."""
    for views in cells.view_sets():
        for column in cells.columns(views):
            for other in cells.variants():
                for metric in COMPARED:
                    difference = cells.difference(views, column, variant, other, metric)
                    if other != variant and difference is not None:
                        yield Gap(views, column, other, metric, difference)


def losses_of(cells: Cells, variant: str) -> list[Gap]:
    """The cells in which ``variant`` is behind, those that are sure first."""
    found = [loss for loss in compared_with(cells, variant) if is_behind(loss.difference, loss.metric)]
    return sorted(found, key=lambda loss: VERDICTS.index(loss.verdict))


def is_behind(difference: Spread, metric: str) -> bool:
    """Whether a difference is for the worse."""
    return difference.mean > 0 if metric in LOWER_IS_BETTER else difference.mean < 0


def losses_table(places: Sequence[str], found: Iterable[tuple[tuple[str, ...], Gap]]) -> Table:
    """A row a place, a column a metric; sure losses in bold. ``places``: head of the columns of a place."""
    rows: dict[tuple[str, ...], list[str]] = {}
    for place, loss in found:
        text = difference_text(loss.difference, None, loss.metric)
        row = rows.setdefault(place, [""] * len(COMPARED))
        row[COMPARED.index(loss.metric)] = Bold(text) if loss.verdict == "sure" else text
    return Table(
        [*places, *(NAMES[metric] for metric in COMPARED)], [[*place, *row] for place, row in rows.items()]
    )
