"""The self-test in Triton's interpreter, small and perhaps with a fault: `python self_test_child.py FAULT`.

``pass`` runs all checks. ``hang`` and ``crash`` plant a kernel that does so into the check of the loss.
"""

from __future__ import annotations

import os
import signal
import sys
import time

if __name__ == "__main__":
    os.environ["TRITON_INTERPRET"] = "1"  # before Triton is imported

from cleargs.splat.kernels.cuda import backend, self_test
from cleargs.splat.kernels.cuda.self_test import Sizes, View

SMALL = Sizes(
    views={
        "a small view": View(10, 18, 17, 3.0, all_outputs=True),
        "a rolling shutter": View(12, 20, 16, 3.0, rolls=True),
        "long tile lists": View(130, 16, 16, 6.0, faint=True),
        "a large view": View(40, 36, 18, 2.0),
    },
    image=(5, 16),
    refined=2000,
    timed=View(6, 8, 8),
    repeats=4,
)

ONE_CHECK = SMALL._replace(views={}, image=(4, 8))
"""The check of the loss comes first. Faults are planted there."""


def hang(*given: object, **options: object) -> None:
    """Never return, as a kernel that hangs."""
    time.sleep(3600)


def crash(*given: object, **options: object) -> None:
    """End the process, as a driver that crashes."""
    os.kill(os.getpid(), signal.SIGSEGV)


def main() -> None:
    fault = sys.argv[1]
    if fault != "pass":
        backend.loss_sums = {"hang": hang, "crash": crash}[fault]
    self_test.main("cpu", SMALL if fault == "pass" else ONE_CHECK)


if __name__ == "__main__":
    main()
