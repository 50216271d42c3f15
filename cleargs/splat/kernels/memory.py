"""How much memory is left for buffers."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path


def available_memory(root: Path = Path("/")) -> int:
    """Bytes that this process may still take without swapping or being killed for it.

    On Linux what the kernel calls MemAvailable, or less where a control group (a container, a batch job)
    leaves less; elsewhere all that the machine has; more than any scene needs where nothing tells.
    ``root`` is where ``proc`` and ``sys`` are looked for.
    """
    machine = 2**62
    with suppress(AttributeError, OSError, ValueError):  # no sysconf (Windows), or none of these names
        machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if "MemAvailable:" in (fields := _fields(root / "proc/meminfo")):  # kB
        machine = fields["MemAvailable:"] * 1024
    return min([machine, *_left_in_groups(root)])


def _left_in_groups(root: Path) -> Iterator[int]:
    """What is left to each limited memory control group that this process is in, version 1 or 2."""
    for line in _read(root / "proc/self/cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            mount, limit, usage = root / "sys/fs/cgroup", "max", "current"
        elif "memory" in controllers.split(","):
            mount, limit, usage = root / "sys/fs/cgroup/memory", "limit_in_bytes", "usage_in_bytes"
        else:
            continue
        # A container may see its own group as the mount point, and still be told the path outside.
        own = Path(path.lstrip("/"))
        for group in (own, *own.parents):
            allowed, used = (_read(mount / group / f"memory.{name}").strip() for name in (limit, usage))
            if allowed.isdigit() and used.isdigit():  # "max" where there is no limit
                # Pages of files count as used but are given back on demand; those of tmpfs are not.
                statistics = _fields(mount / group / "memory.stat")
                cache = statistics.get("file", statistics.get("total_cache", 0))  # version 2, version 1
                kept = statistics.get("total_shmem", statistics.get("shmem", 0))
                yield int(allowed) - int(used) + cache - kept


def _fields(file: Path) -> dict[str, int]:
    """The lines "name number ..." of a file."""
    rows = (line.split() for line in _read(file).splitlines())
    return {row[0]: int(row[1]) for row in rows if len(row) > 1 and row[1].isdigit()}


def _read(file: Path) -> str:
    """The text of a file; nothing where there is none that can be read."""
    try:
        return file.read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""
