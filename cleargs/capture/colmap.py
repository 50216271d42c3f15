"""pycolmap, after numpy, without the signal handler that importing it installs, and without its log files.

Its logging library, glog, catches SIGTERM, prints a stack trace and ends the process, and writes files into
TMPDIR. All modules import pycolmap from here, so that the program's own handler of SIGTERM stays and no file
is left. NumPy is imported first: pycolmap 4.2.1 as a program's first import does not work together with
Pillow 13.0.0.
"""

from __future__ import annotations

import signal
import threading

import numpy  # before pycolmap: else a later import of Pillow or Matplotlib aborts the process
import pycolmap

__all__ = ["numpy", "pycolmap"]

if threading.current_thread() is threading.main_thread():  # Python sets signal handlers nowhere else
    # glog changed the handler without Python, which still knows the one before.
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)

for level in pycolmap.logging.Level.__members__.values():
    pycolmap.logging.set_log_destination(level, "")
