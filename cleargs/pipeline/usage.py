"""What a stage used of the machine: processor time and memory."""

from __future__ import annotations

import resource
import sys
from contextlib import suppress
from pathlib import Path

_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")
_RESET_PEAK = "5"
_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes of a unit of ru_maxrss


class Usage:
    """Counts from where it is made.

    The kernel's mark of the peak is set back where it can be (Linux). Elsewhere the peak is that of the
    process so far, which may be an earlier stage's.
    """

    def __init__(self) -> None:
        with suppress(OSError):
            _CLEAR.write_text(_RESET_PEAK)
        self._before = _cpu_seconds()
        self._children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss

    @property
    def cpu_seconds(self) -> float:
        """Processor time of all threads, and of children that have ended, seconds."""
        return _cpu_seconds() - self._before

    @property
    def peak_memory_gb(self) -> float:
        """Largest resident memory, GB (1e9 bytes); a child counts where it was larger than any before."""
        peak = _high_water()
        children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        if children > self._children:
            peak = max(peak, children * _UNIT)
        return peak / 1e9


def _cpu_seconds() -> float:
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(used.ru_utime + used.ru_stime for used in both)


def _high_water() -> int:
    """Bytes."""
    with suppress(OSError):
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _UNIT
