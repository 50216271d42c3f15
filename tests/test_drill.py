"""A short kill drill: two kills of each of the five stages and ``gc``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

DRILL = Path(__file__).with_name("drill.py")


@pytest.mark.slow
def test_what_was_killed_ends_with_the_same_digests() -> None:
    done = subprocess.run([sys.executable, DRILL, "--kills", "12"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    killed = "{'ingest': 2, 'rva': 2, 'g0': 2, 'rivr': 2, 'consolidate': 2, 'gc': 2}"
    assert done.stdout.splitlines()[-1].startswith(f"killed {killed}")
