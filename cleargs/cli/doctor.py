"""``cleargs doctor``: what this machine offers, and what stands in the way."""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal, NamedTuple

import click

import cleargs
from cleargs.cli.common import answer, json_option
from cleargs.models.onnx import installed_runtimes
from cleargs.pipeline.session import UNUSED_GPU, cuda_obstacle, usable_cores
from cleargs.splat.kernels.memory import available_memory
from cleargs.splat.pace import cached_pace

LIBRARIES = (
    "torch",
    "numba",
    "numpy",
    "pycolmap",
    "OpenImageIO",
    "onnxruntime",
    "opencv-contrib-python-headless",
    "pyarrow",
    "av",
)
MIN_MEMORY_GB = 4.0
MIN_DISK_GB = 5.0


class Finding(NamedTuple):
    """One thing looked at."""

    what: str
    state: Literal["ok", "note", "bad"]
    text: str


@click.command()
@click.argument("folder", default=".", type=click.Path(file_okay=False, exists=True, path_type=Path))
@json_option
def doctor(folder: Path, as_json: bool) -> int:
    """Check this machine: versions, cores, memory, disk, device, caches.

    FOLDER is where runs would be kept. Exit code 1 when something would keep a run from working.
    """
    obstacle, pace = cuda_obstacle(), cached_pace()
    device = f"cpu; {UNUSED_GPU}" if obstacle is None else f"cpu ({obstacle})"
    speed = "not measured yet" if pace is None else f"takes {pace:.2f} of the reference machine's time"
    findings = [
        Finding("cleargs", "ok", f"{cleargs.__version__}, Python {platform.python_version()}"),
        *(_library(name) for name in LIBRARIES),
        Finding("cores", "ok", str(usable_cores())),
        _room(
            "memory",
            available_memory(),
            MIN_MEMORY_GB,
            "",
            f"a run may want {MIN_MEMORY_GB:.0f} GB: lower ingest.max_size",
        ),
        _room(
            "disk",
            shutil.disk_usage(folder).free,
            MIN_DISK_GB,
            f" at {folder.absolute()}",
            "cleargs gc frees what no run needs",
        ),
        Finding("device", "note" if obstacle is None else "ok", device),
        Finding("pace", "ok", speed),
        _writable("runs", folder),
        _writable("caches", Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")),
        _writable("temporary files", Path(tempfile.gettempdir())),
    ]
    lines = (f"{state:<5} {what:<32} {text}" for what, state, text in findings)
    answer(as_json, [finding._asdict() for finding in findings], *lines)
    return 1 if any(finding.state == "bad" for finding in findings) else 0


def _library(name: str) -> Finding:
    if name == "onnxruntime" and (found := installed_runtimes()) != "absent":  # under any of its names
        return Finding(name, "ok", found)
    try:
        return Finding(name, "ok", version(name))
    except PackageNotFoundError:
        return Finding(name, "bad", "not installed: install cleargs again")


def _room(what: str, free: float, least_gb: float, place: str, advice: str) -> Finding:
    """How many bytes are ``free``, with ``advice`` where they are few."""
    words = f"{free / 1e9:.1f} GB free{place}"
    enough = free / 1e9 >= least_gb
    return Finding(what, "ok" if enough else "note", words if enough else f"{words}; {advice}")


def _writable(what: str, folder: Path) -> Finding:
    place = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    try:
        with tempfile.TemporaryFile(dir=place):
            return Finding(what, "ok", f"{folder.absolute()} can be written")
    except OSError as error:
        return Finding(what, "bad", f"{folder.absolute()} cannot be written: {error.strerror}")
