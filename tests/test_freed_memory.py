"""Freed memory goes back to the system."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

from cleargs.memory import release_freed


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc alone keeps such blocks")
def test_freed_blocks_below_one_in_use_are_released() -> None:
    blocks = [bytearray(b"1") * 100_000 for _ in range(2000)]
    last = bytearray(b"1") * 100_000
    del blocks
    before = _resident()
    release_freed()
    assert before - _resident() > 150e6
    assert len(last) == 100_000


def _resident() -> int:
    """Return the memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096
