"""Tables and chart of the front page of the results. Its text is written by hand.

A table is between the lines ``<!-- NAME -->`` and ``<!-- /NAME -->`` of a page.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.comparison.cells import Cells, Spread, ViewSet
from benchmarks.comparison.saved_sections import SavedSection
from benchmarks.comparison.tables import Table
from benchmarks.comparison.variants import WHOLE
from cleargs.errors import InputError
from cleargs.files import atomic_path

FAULTS: Mapping[str, str] = {
    "sharp": "no fault",
    "gs2e-slight": "motion blur of 6 px",
    "gsotm-mb": "motion blur of 8 px",
    "gs2e-medium": "motion blur of 12 px",
    "gs2e-stretches": "motion blur of 14 px in groups of 12 frames",
    "gs2e-severe": "motion blur of 20 px",
    "tremor": "bent motion blur of 12 px, of a hand that holds still",
    "gsotm-rs": "rolling shutter of 12 px",
    "gsotm-mb-rs": "motion blur of 8 px and rolling shutter of 12 px",
    "mixed": "blur, defocus or a wrong exposure in every other frame",
    "phone": "a phone's video: blur, rolling shutter, exposure, noise, compression, a thing that moves",
    "moving": "a phone's video through which a person walks",
    "moving-severe": "a phone's video with much movement",
    "gsotm-pn": "sharp frames with inexact poses",
}
"""Protocol of `cleargs synth` -> its faults in words; px are mean lengths at a width of 640 px."""

BASELINE = "all-view"
SECTIONS = ("default-length-aligned", "default-length")
"""Sections of the front page. The first one with a protocol gives the row of the protocol."""


@dataclass(frozen=True)
class FaultRow:
    """Means of one protocol, and the gain of the whole method over training on all frames with weight 1."""

    fault: str
    before: tuple[float, float | None]
    """PSNR and LPIPS (AlexNet) at the poses of the input."""
    after: tuple[float, float | None]
    gain: Spread
    """Paired difference of PSNR at the poses of the input."""
    novel: Spread | None
    """The same at views off the path."""
    samples: int


def fault_rows(found: Sequence[SavedSection]) -> list[FaultRow]:
    """Return a row per protocol of `SECTIONS`, in the order of `FAULTS`."""
    sections = {saved.section.name: saved.results.cells for saved in found}
    rows = []
    for protocol, words in FAULTS.items():
        cells = next(
            (sections[name] for name in SECTIONS if name in sections and _has(sections[name], protocol)), None
        )
        if cells is None:
            continue
        gain = cells.difference("observed", protocol, WHOLE, BASELINE, "psnr")
        if gain is None:
            continue
        before, after = (_psnr_and_lpips(cells, protocol, variant) for variant in (BASELINE, WHOLE))
        novel = cells.difference("novel", protocol, WHOLE, BASELINE, "psnr")
        rows.append(FaultRow(words, before, after, gain, novel, gain.count))
    return rows


def fault_table(found: Sequence[SavedSection]) -> str:
    """Return the table of faults as Markdown, with its conditions; "" without its sections."""
    rows = fault_rows(found)
    if not rows:
        return ""
    head = ["synthetic rooms, by fault", "all frames alike", "ClearGS", "gain"]
    texts = [[row.fault, _pair(row.before), _pair(row.after), bold_difference(row.gain, 1)] for row in rows]
    saved = [one for one in found if one.section.name in SECTIONS]
    section = saved[0].section
    versions = " and ".join(dict.fromkeys(without_digest(one.version) for one in saved))
    size = "x".join(map(str, section.size))
    line = (
        f"Means of {rows[0].samples} rooms, {section.frames} frames of {size}, {section.steps:,} steps, at "
        "the poses of the input. ± is half the 95 % interval of the difference; bold excludes zero. "
        f"Version {versions}."
    )
    return f"{Table(head, texts).markdown()}\n\n{line}"


def without_digest(text: str) -> str:
    """Remove the digests of the sources after the versions in ``text``: readers do not need them."""
    return re.sub(r", source \w+", "", text)


def _has(cells: Cells, protocol: str) -> bool:
    return bool(cells.of("observed", protocol, WHOLE) and cells.of("observed", protocol, BASELINE))


def _psnr_and_lpips(cells: Cells, protocol: str, variant: str) -> tuple[float, float | None]:
    views: ViewSet = "observed"
    psnr = cells.spread(views, protocol, variant, "psnr")
    lpips = cells.spread(views, protocol, variant, "lpips_alex")
    assert psnr is not None  # the difference has it
    return psnr.mean, lpips.mean if lpips else None


def _pair(means: tuple[float, float | None]) -> str:
    psnr, lpips = means
    return f"{psnr:.1f} / {'-' if lpips is None else f'{lpips:.3f}'}"


def bold_difference(difference: Spread, digits: int) -> str:
    """Return a difference with half its 95 % interval, in bold if the interval excludes 0."""
    text = f"{difference.mean:+.{digits}f}"
    if difference.half_width is not None:
        text += f" ± {difference.half_width:.{digits}f}"
    return f"**{text}**" if difference.excludes_zero else text


def plot_gains(path: Path, rows: Sequence[FaultRow]) -> None:
    """Write a PNG: per fault, the gain at the poses of the input and off the path, with 95 % intervals."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panel = pyplot.subplots(figsize=(9.0, 0.3 * len(rows) + 1.0), layout="constrained")
    places = range(len(rows) - 1, -1, -1)  # the first row is at the top
    series = (
        ("at the filmed views", [row.gain for row in rows], 0.12, "#3f51b5"),
        ("at new viewpoints", [row.novel for row in rows], -0.12, "#e07a1f"),
    )
    for label, gains, shift, colour in series:
        shown = [(place + shift, gain) for place, gain in zip(places, gains, strict=True) if gain]
        panel.errorbar(
            [gain.mean for _, gain in shown],
            [place for place, _ in shown],
            xerr=[gain.half_width or 0.0 for _, gain in shown],
            fmt="o",
            color=colour,
            markersize=6,
            label=label,
        )
    panel.axvline(0.0, color="black", linewidth=0.8)
    panel.set_yticks(list(places), [row.fault.split(":")[0] for row in rows], fontsize=9)
    panel.set_xlabel("gain of ClearGS over training on all frames alike, PSNR in dB", fontsize=9)
    panel.grid(axis="x", alpha=0.3)
    panel.legend(frameon=False, fontsize=9)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
    pyplot.close(figure)


def with_block(page: str, name: str, text: str) -> str:
    """Return ``page`` with ``text`` between the lines ``<!-- NAME -->`` and ``<!-- /NAME -->``.

    Raises:
        InputError: if the page has no such lines.
    """
    block = _block(name)
    if not block.search(page):
        raise InputError(
            f"the page has no place for the table {name!r}", hint=f"add <!-- {name} --> and <!-- /{name} -->"
        )
    return block.sub(lambda match: f"{match[1]}\n{text}\n\n{match[2]}", page)


def has_block(page: str, name: str) -> bool:
    """Return True if `with_block` finds its lines."""
    return _block(name).search(page) is not None


def _block(name: str) -> re.Pattern[str]:
    return re.compile(rf"(<!-- {re.escape(name)} -->\n).*?(<!-- /{re.escape(name)} -->)", re.DOTALL)
