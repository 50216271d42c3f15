"""``python -m cleargs``: the program ``cleargs``."""

from cleargs.cli.entry import main

main()
