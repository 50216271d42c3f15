"""pycolmap, without the signal handler that importing it installs.

Its glog catches SIGTERM, prints a stack trace and dies of the signal. Whoever imports pycolmap does it
through here, so that SIGTERM stays what the program made of it.
"""

from __future__ import annotations

import signal
import threading

import pycolmap

__all__ = ["pycolmap"]

if threading.current_thread() is threading.main_thread():  # Python sets signal handlers nowhere else
    # glog changed the handler behind Python's back: what Python remembers is the one before.
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
