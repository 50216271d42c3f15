"""Where the console script begins: Ctrl-C ends the program without a word until it can answer.

`cleargs.cli.main` takes a moment to import; Python's own answer in that time would be a traceback.
"""

from __future__ import annotations

import os
import signal
import sys

signal.signal(signal.SIGINT, signal.SIG_DFL)


def main() -> None:
    """Run the command line and exit; with 2 where this is not Linux."""
    if not sys.platform.startswith("linux"):
        print(f"error: ClearGS runs on Linux, this is {sys.platform}", file=sys.stderr)
        print("hint: use a Linux machine or container; on Windows, WSL 2", file=sys.stderr)
        sys.exit(2)
    # OpenMP's threads wait for each other asleep: awake, each would hold a core that another program, or the
    # very thread that they wait for, could have. Read once, when PyTorch loads it.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from cleargs.cli.main import main as run

    try:
        run()
    finally:  # the work is done: there is nothing left to interrupt
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
