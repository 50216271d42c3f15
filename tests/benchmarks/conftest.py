"""Paths to helpers of other test folders that the tests of the benchmarks use."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path += [str(Path(__file__).parents[1] / name) for name in ("report", "rva")]
