"""Choice of items of a sequence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")


def spread(items: Sequence[T], at_most: int) -> list[T]:
    """Return at most ``at_most`` of ``items``, evenly by position, with the first and the last."""
    if len(items) <= at_most:
        return list(items)
    step = (len(items) - 1) / max(1, at_most - 1)
    return [items[round(index * step)] for index in range(at_most)]
