"""Where the console script begins: Ctrl-C ends the program without a word until it can answer.

`cleargs.cli.main` takes a moment to import; Python's own answer in that time would be a traceback.
"""

from __future__ import annotations

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)


def main() -> None:
    """Run the command line and exit."""
    from cleargs.cli.main import main as run

    run()
