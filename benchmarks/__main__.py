"""``python -m benchmarks``, from the root of a checkout."""

from __future__ import annotations

import os


def main() -> None:
    """Run the command line and exit."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # set before PyTorch loads, as in `cleargs`
    from benchmarks.commands import main as run

    run()


if __name__ == "__main__":
    main()
