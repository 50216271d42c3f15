"""The console script, also ``python -m cleargs.cli.entry``."""

from __future__ import annotations

import os
import signal
import sys


def main() -> None:
    """Run the command line and exit; with 2 where this is not Linux."""
    # The import below takes a moment, in which Python would answer Ctrl-C with a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if not sys.platform.startswith("linux"):
        print(f"error: ClearGS runs on Linux, this is {sys.platform}", file=sys.stderr)
        print("hint: use a Linux machine or container; on Windows, WSL 2", file=sys.stderr)
        sys.exit(2)
    # OpenMP threads that wait awake would hold a core that another program, or the very thread that they
    # wait for, could have. PyTorch reads it once, when it is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from cleargs.cli.main import main as run

    try:
        run()
    finally:  # the work is done: there is nothing left to interrupt
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


if __name__ == "__main__":
    main()
