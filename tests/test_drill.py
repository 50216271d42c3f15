"""The shortest kill drill: one kill of each of the five stages and ``gc``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

DRILL = Path(__file__).with_name("drill.py")


@pytest.mark.slow
def test_what_was_killed_ends_with_the_same_digests() -> None:
    done = subprocess.run([sys.executable, DRILL, "--kills", "6"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    killed = "{'ingest': 1, 'rva': 1, 'g0': 1, 'rivr': 1, 'consolidate': 1, 'gc': 1}"
    assert done.stdout.splitlines()[-1].startswith(f"killed {killed}")
