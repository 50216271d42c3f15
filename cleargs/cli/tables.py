"""Figures in words, and tables on the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

MAX_LISTED = 16
"""Most items of a list that are spelt out."""

HIDDEN = frozenset({"similarity", "holdout_hash", "round"})
"""Figures for programs."""

LABELS: Mapping[str, str] = {
    "registered": "frames with a pose",
    "test": "frames held out for testing",
    "given_poses_missed_px": "median distance of features from their points at the given poses, px",
    "stand_in": "frames that stand in for reliable ones",
    "effective_frames": "equivalent frames of full weight",
    "bins": "stretches of the trajectory",
    "bins_uncovered_before": "stretches without a usable frame at first",
    "psnr_strong": "training PSNR of the strong frames, dB",
    "psnr_active": "training PSNR, dB",
    "psnr_unseen": "PSNR of pixels that no training saw, dB",
    "psnr_before": "PSNR in the first scene, dB",
    "psnr_after": "PSNR now, dB",
    "repairs_refused": "repairs refused by the gate",
    "tie_breaks": "decided by the tie-break scorer",
    "latest_rounds": "repairs by round",
}
"""Figure of a manifest -> its label, where its name is not enough."""


def labelled(summary: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Label and text of each figure: numbers of one kind in one line, other nested figures in their own."""
    for name, value in summary.items():
        label = prefix + LABELS.get(name, name.replace("_", " "))
        if name in HIDDEN:
            continue
        if name in ("weights", "latest_rounds"):
            word = "from" if name == "weights" else "in round"
            yield label, ", ".join(f"{count} {word} {item}" for item, count in value.items() if count)
        elif name == "harm":
            yield label, value or "none"
        elif isinstance(value, Mapping) and any(
            key in LABELS or isinstance(item, Mapping | list) for key, item in value.items()
        ):
            yield from labelled(value, f"{label}: ")
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            for number, item in enumerate(value, 1):
                yield from labelled(item, f"round {number}: ")
        elif text := text_of(value):
            yield label, text


def text_of(value: Any) -> str:
    """A value for a reader: four figures of a number, yes and no, "9 restored, 3 render" for counts."""
    match value:
        case None:
            return ""
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.4g}"
        case list():
            return ", ".join(map(text_of, value[:MAX_LISTED])) + (" ..." if len(value) > MAX_LISTED else "")
        case Mapping():
            names = {name: name.replace("_", " ").replace("observed", "as filmed") for name in value}
            if not all(isinstance(item, int) for item in value.values()):
                return ", ".join(f"{names[name]} {text_of(item)}" for name, item in value.items())
            return ", ".join(f"{count} {names[name]}" for name, count in value.items() if count) or "none"
    return str(value)


def new_table(*columns: str, title: str = "") -> Table:
    """An empty table without lines; one without ``columns`` has labels in its first column."""
    from rich.table import Table

    table = Table(*columns, box=None, header_style="bold", padding=(0, 2, 0, 0), pad_edge=False)
    table.title, table.title_justify, table.show_header = title or None, "left", bool(columns)
    if not columns:
        table.add_column(no_wrap=True)
    return table


def line_table(title: str, lines: Iterable[tuple[str, str]]) -> Table:
    """A table with a label and a text per line."""
    table = new_table(title=title)
    for line in lines:
        table.add_row(*line)
    return table


def print_table(table: Table) -> None:
    """Print a table; brackets in names are no markup."""
    from rich.console import Console

    Console(highlight=False, markup=False, emoji=False).print(table)
