"""Memory that is left for buffers."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path


def available_memory(root: Path = Path("/")) -> int:
    """Return the number of bytes that this process can allocate without swapping or being killed.

    On Linux this is the kernel's MemAvailable, or less if a control group (a container, a batch job) has less
    left. On other systems it is the memory of the machine, or 2^62 if that is unknown. ``root`` contains
    ``proc`` and ``sys``.
    """
    machine = 2**62
    with suppress(AttributeError, OSError, ValueError):  # Windows has no sysconf, others may lack the names
        machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if "MemAvailable:" in (fields := _fields(root / "proc/meminfo")):  # kB
        machine = fields["MemAvailable:"] * 1024
    return min([machine, *_cgroup_headroom(root)])


def _cgroup_headroom(root: Path) -> Iterator[int]:
    """Yield the bytes left in each limited memory control group (version 1 or 2) of this process."""
    for line in _read(root / "proc/self/cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            mount, limit, usage = root / "sys/fs/cgroup", "max", "current"
        elif "memory" in controllers.split(","):
            mount, limit, usage = root / "sys/fs/cgroup/memory", "limit_in_bytes", "usage_in_bytes"
        else:
            continue
        # In a container, the mount point can be the container's group, while the path is that on the host.
        own = Path(path.lstrip("/"))
        for group in (own, *own.parents):
            allowed, used = (_read(mount / group / f"memory.{name}").strip() for name in (limit, usage))
            if allowed.isdigit() and used.isdigit():  # "max" means no limit
                # Cached pages of files count as used, but can be freed on demand. Pages of tmpfs cannot.
                statistics = _fields(mount / group / "memory.stat")
                cache = statistics.get("file", statistics.get("total_cache", 0))  # version 2, version 1
                tmpfs = statistics.get("total_shmem", statistics.get("shmem", 0))
                yield int(allowed) - int(used) + cache - tmpfs


def _fields(file: Path) -> dict[str, int]:
    """Return the lines "name number" of a file as a dictionary."""
    rows = (line.split() for line in _read(file).splitlines())
    return {row[0]: int(row[1]) for row in rows if len(row) > 1 and row[1].isdigit()}


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""
