"""Numbers in words, as a report says them."""

from __future__ import annotations


def count(number: int, one: str, many: str = "") -> str:
    """``3 frames``, ``1 frame``."""
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def duration(seconds: float) -> str:
    """``4.0 s``, ``3.4 min``, ``2.1 h``."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
