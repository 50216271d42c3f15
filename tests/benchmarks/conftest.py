"""What the tests of the programs that measure ClearGS borrow from the tests of ClearGS."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path += [str(Path(__file__).parents[1] / name) for name in ("report", "rva")]
