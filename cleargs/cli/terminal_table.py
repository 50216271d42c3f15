"""A table in the terminal, which cuts nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import zip_longest

import click
from rich.console import Console
from rich.table import Table

_NARROWEST = 24  # columns of a terminal that labels have at least


def print_table(rows: Iterable[Sequence[str]], *columns: str, title: str = "", wraps: str = "") -> None:
    """Print a table without rules. ``columns`` are its heads; without heads, the first column has labels.

    Labels wrap before values do. Only the column with the head ``wraps`` may wrap. With ``wraps`` the columns
    are closer together. Nothing is cut: lines may be longer than the terminal.
    Brackets in cells are not treated as markup.
    """
    rows, console = list(rows), Console(highlight=False, markup=False, emoji=False)
    gap = (0, 1 if wraps else 2, 0, 0)
    table = Table(*columns, box=None, header_style="bold", padding=gap, pad_edge=False)
    table.title, table.title_justify, table.show_header = title or None, "left", bool(columns)
    if not columns:
        longest = max((len(value) for _, value in rows), default=0)
        table.add_column(max_width=max(_NARROWEST, console.width - 2 - longest))
    for column in table.columns:
        column.overflow = "fold"
        column.no_wrap |= bool(wraps) and column.header != wraps
        column.min_width = 14 if column.header == wraps else None
    for row in rows:
        table.add_row(*row)
    least = 0
    for column, cells in zip(table.columns, zip_longest(*rows, columns, fillvalue=""), strict=True):
        column.no_wrap |= all(len(text.split()) < 2 for text in cells[:-1])
        parts = (part for text in cells for part in ([text] if column.no_wrap else _words(text)))
        column.min_width = max(column.min_width or 0, *map(len, parts))
        least += column.min_width
    console.width = max(console.width, least + gap[1] * (len(table.columns) - 1))
    with console.capture() as printed:
        console.print(table)
    for line in printed.get().splitlines():  # in a narrow terminal, spaces at the end would fill another line
        click.echo(line.rstrip())


def _words(text: str) -> list[str]:
    """Return the words of ``text``, each as far from the left as the first one."""
    indent = len(text) - len(text.lstrip())
    return [" " * indent + word for word in text.split()] or [""]
