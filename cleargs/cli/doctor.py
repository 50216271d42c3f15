"""``cleargs doctor``: a check of this machine."""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
from pathlib import Path
from typing import Literal, NamedTuple

import click

import cleargs
from cleargs.cli.common import answer, json_option
from cleargs.cli.user_config import user_config_file
from cleargs.gpu import Machine
from cleargs.models.onnx import installed_runtimes
from cleargs.pipeline.session import usable_cores
from cleargs.plugins import installed_version
from cleargs.splat.kernels.memory import available_memory

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


class Finding(NamedTuple):
    """The result of one check."""

    what: str
    state: Literal["ok", "note", "bad"]
    text: str


@click.command()
@click.argument("folder", default=".", type=click.Path(file_okay=False, exists=True, path_type=Path))
@click.option("--gpu", "wants_test", is_flag=True, help="Run the self-test of the GPU and print its result.")
@json_option
def doctor(folder: Path, wants_test: bool, as_json: bool) -> int:
    """Check this machine: versions, cores, memory, disk, device, caches.

    FOLDER is the folder for runs. The exit code is 1 if a run would fail on this machine.
    """
    config = user_config_file()
    device, report = device_of(Machine(), wants_test)
    findings = [
        Finding("cleargs", "ok", f"{cleargs.__version__}, Python {platform.python_version()}"),
        *(_library(name) for name in LIBRARIES),
        Finding("cores", "ok", str(usable_cores())),
        _room("memory", available_memory(), 4.0, "a run may want 4 GB: lower ingest.max_size"),
        _room("disk", shutil.disk_usage(folder).free, 5.0, "cleargs gc frees what no run needs"),
        device,
        Finding("configuration", "ok", f"{'' if config.is_file() else 'no '}{config}"),
        _writable("runs", folder),
        _writable("caches", Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")),
        _writable("temporary files", Path(tempfile.gettempdir())),
    ]
    lines = (f"{state:<5} {what:<32} {text}" for what, state, text in findings)
    answer(as_json, [finding._asdict() for finding in findings], *lines, *report)
    return 1 if any(finding.state == "bad" for finding in findings) else 0


def device_of(machine: Machine, wants_test: bool) -> tuple[Finding, list[str]]:
    """Return the device that ``--device auto`` chooses, and the lines of the self-test if ``wants_test``."""
    if (obstacle := machine.obstacle()) is not None:
        return Finding("device", "bad" if wants_test else "ok", f"cpu ({obstacle})"), []
    facts, report = machine.facts(), []
    if wants_test:
        tested = machine.self_test(facts, lambda line: click.echo(line, err=True))
        report = ["", *tested.lines()]
    elif (found := machine.cached_test(facts)) is not None:
        tested = found
    else:
        return Finding("device", "note", "cpu (the GPU is not tested yet: cleargs doctor --gpu)"), []
    failed: Literal["note", "bad"] = "bad" if wants_test else "note"
    state = "ok" if tested.fault is None else failed
    return Finding("device", state, f"{tested.device} ({tested.reason})"), report


def _library(name: str) -> Finding:
    found = installed_runtimes() if name == "onnxruntime" else installed_version(name)  # several packages
    if found == "absent":
        return Finding(name, "bad", "not installed: install cleargs again")
    return Finding(name, "ok", found)


def _room(what: str, free: float, least_gb: float, advice: str) -> Finding:
    """Return a finding about ``free`` bytes, with ``advice`` if there are too few."""
    enough, words = free / 1e9 >= least_gb, f"{free / 1e9:.1f} GB free"
    return Finding(what, "ok" if enough else "note", words if enough else f"{words}; {advice}")


def _writable(what: str, folder: Path) -> Finding:
    place = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    try:
        with tempfile.TemporaryFile(dir=place):
            return Finding(what, "ok", f"{folder.absolute()} can be written")
    except OSError as error:
        return Finding(what, "bad", f"{folder.absolute()} cannot be written: {error.strerror}")
