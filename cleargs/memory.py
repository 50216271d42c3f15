"""Memory that was freed, but that the C library keeps for later."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from functools import cache
from typing import Any


def release_freed() -> None:
    """Give freed memory back to the system: glibc keeps up to hundreds of MB between blocks in use.

    It takes some milliseconds. With other C libraries nothing happens.
    """
    if (trim := _trim()) is not None:
        trim(0)


@cache
def _trim() -> Callable[[int], Any] | None:
    if sys.platform != "linux":
        return None
    return getattr(ctypes.CDLL(None), "malloc_trim", None)
