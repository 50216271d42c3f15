"""Entry point of the program ``cleargs``, also as ``python -m cleargs``."""

from __future__ import annotations

import os
import signal
import sys


def main() -> None:
    """Run the command line and exit. The exit code is 2 on Windows."""
    # During the import below, Python would answer Ctrl-C with a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if sys.platform == "win32":
        print("error: ClearGS does not run on Windows itself", file=sys.stderr)
        print("hint: use WSL 2 or a container", file=sys.stderr)
        sys.exit(2)
    if sys.getfilesystemencoding() != "utf-8" and os.environ.get("PYTHONUTF8") != "1":
        # In a locale such as Latin-1, Python and the libraries would read the bytes of a path differently.
        for name in ("stdout", "stderr"):  # the output keeps the encoding of the terminal
            os.environ.setdefault("PYTHONIOENCODING", getattr(getattr(sys, name), "encoding", "") or "")
        os.environ["PYTHONUTF8"] = "1"
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    # Waiting OpenMP threads should sleep: awake, they take a core from other programs, or even from the
    # thread for which they wait. PyTorch reads the variable when it is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from cleargs.cli.main import main as run
    from cleargs.program import name_program

    name_program()
    try:
        run()
    finally:  # the command has ended: there is nothing left to interrupt
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
