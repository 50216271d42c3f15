"""The table of ``cleargs show RUN time``: the time of each stage by its parts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from cleargs.manifest import Manifest
from cleargs.timing import PartTime

HEADS = ("part", "seconds", "processor s", "times", "")
LEAST = 0.005  # share of a stage that a line has at least
BAR = 20  # characters of a bar as long as its stage
REST = "the rest"


def time_rows(done: Mapping[str, Manifest]) -> Iterator[Sequence[str]]:
    """Yield the cells of each line, with `HEADS`: each stage, then its parts, indented under each other.

    The bars show processor time, which other programs change little. The remainder of a part is `REST`, with
    the processor time of a child process that worked in several parts: it counts at the end of the process.
    """
    for name, manifest in done.items():
        total = manifest.cpu_seconds or manifest.seconds
        yield _cells(name, 0, manifest.seconds, total, None, total)
        whole = PartTime(part=(), seconds=manifest.seconds, cpu_seconds=total, times=1)
        yield from _below(whole, manifest.timing, total, manifest.seconds)


def _below(parent: PartTime, parts: Sequence[PartTime], total: float, wall: float) -> Iterator[Sequence[str]]:
    depth = len(parent.part)
    own = [one for one in parts if len(one.part) == depth + 1 and one.part[:depth] == parent.part]
    for one in own:
        if one.cpu_seconds >= LEAST * total or one.seconds >= LEAST * wall:
            yield _cells(one.part[-1], depth + 1, one.seconds, one.cpu_seconds, one.times, total)
            yield from _below(one, parts, total, wall)
    rest = parent.cpu_seconds - sum(one.cpu_seconds for one in own)
    if own and rest >= LEAST * total:
        left = max(0.0, parent.seconds - sum(one.seconds for one in own))
        yield _cells(REST, depth + 1, left, rest, None, total)


def _cells(
    name: str, depth: int, seconds: float, cpu_seconds: float, times: int | None, total: float
) -> Sequence[str]:
    bar = "#" * round(BAR * min(1.0, cpu_seconds / total)) if total > 0.0 else ""
    counted = "" if times is None else str(times)
    return ["  " * depth + name, f"{seconds:.1f}", f"{cpu_seconds:.1f}", counted, bar]
