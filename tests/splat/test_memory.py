"""Memory that is left in a container, and pairs that would not fit."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.splat_scenes import make_camera, make_gaussians

from cleargs.errors import StageError
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.kernels import rasteriser
from cleargs.splat.kernels.cpu.pipeline import CpuRasteriser
from cleargs.splat.kernels.memory import available_memory

GB = 2**30


def machine(root: Path, files: dict[str, str]) -> Path:
    """Write a root folder with 8 GB of available memory and these files."""
    given = {"proc/meminfo": f"MemTotal: {2**24} kB\nMemAvailable: {2**23} kB\n"} | files
    for name, text in given.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


VERSION_2 = {
    "proc/self/cgroup": "0::/batch/job\n",
    "sys/fs/cgroup/batch/job/memory.max": "max\n",
    "sys/fs/cgroup/batch/job/memory.current": f"{GB}\n",
    "sys/fs/cgroup/batch/memory.max": f"{4 * GB}\n",
    "sys/fs/cgroup/batch/memory.current": f"{3 * GB}\n",
    "sys/fs/cgroup/batch/memory.stat": f"anon {GB}\nfile {2 * GB}\nshmem {GB // 2}\n",
}
VERSION_1 = {
    "proc/self/cgroup": "5:cpu:/docker/abc\n4:memory,hugetlb:/docker/abc\n0::/docker/abc\n",
    "sys/fs/cgroup/memory/memory.limit_in_bytes": f"{3 * GB}\n",
    "sys/fs/cgroup/memory/memory.usage_in_bytes": f"{2 * GB}\n",
    "sys/fs/cgroup/memory/memory.stat": f"cache 5\nshmem 5\ntotal_cache {GB}\ntotal_shmem {GB // 4}\n",
}


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, 8 * GB),
        # The job has no limit, but its slice has. 1.5 GB of the slice's memory is a cache of files.
        (VERSION_2, 4 * GB - 3 * GB + 2 * GB - GB // 2),
        # In a container the group is the mount point, while the path is the one outside.
        (VERSION_1, 3 * GB - 2 * GB + GB - GB // 4),
        (VERSION_1 | {"sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712\n"}, 8 * GB),
    ],
    ids=["none", "version 2", "version 1 in a container", "unlimited"],
)
def test_control_groups_limit_the_memory(files: dict[str, str], expected: int, tmp_path: Path) -> None:
    assert available_memory(machine(tmp_path, files)) == expected


def test_without_proc_it_is_the_memory_of_the_machine(tmp_path: Path) -> None:
    assert available_memory(tmp_path) >= available_memory()


def test_pairs_that_do_not_fit_are_not_allocated(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = make_camera()
    gaussians = make_gaussians(camera, 200)
    buffers = rasteriser.Buffers(torch.device("cpu"))
    monkeypatch.setattr(rasteriser, "Buffers", lambda device: buffers)
    monkeypatch.setattr(rasteriser, "UNCHECKED_BYTES", 0)
    monkeypatch.setattr(rasteriser, "available_memory", lambda device: 1000)
    engine = rasteriser_for()
    with pytest.raises(StageError, match=r"pairs at 64x48, more than fit: they need another .* GB"):
        engine.forward(gaussians, camera)
    assert not any(name in buffers.memory for name in CpuRasteriser.pair_buffers)
    # Memory that the buffers already hold is not free, and need not be.
    monkeypatch.setattr(rasteriser, "available_memory", lambda device: 10**6)
    image = engine.forward(gaussians, camera).image
    engine.backward(image)
    assert set(CpuRasteriser.pair_buffers) <= set(buffers.memory)
    monkeypatch.setattr(rasteriser, "available_memory", lambda device: 0)
    engine.forward(gaussians, camera)
