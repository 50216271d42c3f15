"""Compiling the kernels, which a machine does once.

`begin` compiles those of the CPU in a child process, while a run reads its capture. `finish` waits for it, or
compiles itself. ``python -m cleargs.splat.compilation`` is the child process.
"""

from __future__ import annotations

import fcntl
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from cleargs.kernel_cache import lasting_folder
from cleargs.progress import COMPILING, Reporter
from cleargs.splat.kernels.cpu.jit import compiled_mark, is_compiled
from cleargs.subprocesses import module_command

_children: list[subprocess.Popen[bytes]] = []


def begin() -> None:
    """Start to compile the kernels of the CPU in a child process, unless this was done on this machine.

    Without a lasting cache folder, this process would not find what another one compiled.
    """
    if lasting_folder("kernels") is None or is_compiled("cpu"):
        return
    if not any(child.poll() is None for child in _children):
        with suppress(OSError):  # `finish` compiles
            command = module_command("cleargs.splat.compilation")
            quiet = subprocess.DEVNULL
            _children.append(subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet))


def finish(device: str, warm_up: Callable[[], None], reporter: Reporter) -> None:
    """Call ``warm_up``, which loads the kernels of a ``device``: ``cpu`` or ``cuda``.

    If they must be compiled, by another process or by this one, that is a task.
    """
    if is_compiled(device):
        warm_up()
        return
    with reporter.task(COMPILING), _compiling(device):
        _compile(device, warm_up)


@contextmanager
def _compiling(device: str) -> Iterator[None]:
    """Wait until no other process compiles for this device, and keep others from it."""
    try:
        node = os.open(f"{compiled_mark(device)}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError:
        yield
        return
    try:
        with suppress(OSError):  # a disk without locks: both compile
            fcntl.flock(node, fcntl.LOCK_EX)
        yield
    finally:
        os.close(node)


def _compile(device: str, warm_up: Callable[[], None]) -> None:
    warm_up()
    with suppress(OSError):
        compiled_mark(device).touch()


def main() -> None:
    """Compile the kernels of the CPU, unless another process did."""
    import torch

    from cleargs.splat.backend import backend_for

    with _compiling("cpu"):
        if not is_compiled("cpu"):
            _compile("cpu", backend_for(torch.device("cpu")).warm_up)


if __name__ == "__main__":
    main()
