"""What a stage used of the machine: processor time and memory."""

from __future__ import annotations

import re
import resource
import sys
from contextlib import suppress
from pathlib import Path

_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes of a unit of ru_maxrss


class Usage:
    """Counts from where it is made.

    The kernel's mark of the peak is set back where it can be (Linux). Elsewhere the peak is that of the
    process so far, which may be an earlier stage's.
    """

    def __init__(self) -> None:
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # sets the mark back
        self._before, self._children = _cpu_seconds(), _children_peak()

    @property
    def cpu_seconds(self) -> float:
        """Processor time of all threads, and of children that have ended, seconds."""
        return _cpu_seconds() - self._before

    @property
    def peak_memory_gb(self) -> float:
        """Largest resident memory, GB (1e9 bytes); a child counts where it was larger than any before."""
        children = _children_peak()
        return max(_own_peak(), children if children > self._children else 0) / 1e9


def _cpu_seconds() -> float:
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(used.ru_utime + used.ru_stime for used in both)


def _children_peak() -> int:
    """Bytes."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * _UNIT


def _own_peak() -> int:
    """Bytes."""
    with suppress(OSError):
        if found := re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text()):
            return int(found[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _UNIT
