"""Text forms of numbers."""

from __future__ import annotations


def count(number: int, one: str, many: str = "") -> str:
    """Format a number with its noun, for example ``3 frames`` or ``1 frame``."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def duration(seconds: float) -> str:
    """Format a time, for example ``4.0 s``, ``3.4 min`` or ``2.1 h``."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
