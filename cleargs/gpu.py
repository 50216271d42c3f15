"""The NVIDIA GPU of this machine: obstacles to its use, its self-test, and the choice of the device.

Nothing here imports torch, which takes seconds. The self-test is a child process: a kernel may hang or crash.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, NamedTuple

import cleargs
from cleargs.errors import StoreError
from cleargs.files import write_json
from cleargs.kernel_cache import cache_folder
from cleargs.plugins import installed_version
from cleargs.safe_io import FAULTS, read_json
from cleargs.subprocesses import module_command

SELF_TEST = "cleargs.splat.kernels.cuda.self_test"

LIMIT_S = 300.0
"""Time limit of the self-test, s. Triton compiles for one to two minutes; the checks take at most one."""

NO_GPU = "there is no NVIDIA GPU"


def cuda_obstacle(root: Path = Path("/")) -> str | None:
    """Return the reason why no NVIDIA GPU can be used, or None. ``root`` contains ``dev`` and ``sys``."""
    if os.environ.get("CUDA_VISIBLE_DEVICES", "0") in ("", "-1"):  # hidden on purpose
        return NO_GPU
    if not any((root / node).exists() for node in ("dev/nvidiactl", "dev/dxg")):
        return "there is an NVIDIA GPU, but its driver is not loaded" if _on_pci_bus(root) else NO_GPU
    if find_spec("triton") is None:
        return "Triton is not installed (pip install 'cleargs[cuda]')"
    if version("torch").endswith("+cpu"):
        return "this PyTorch is built for the CPU only (install a CUDA build)"
    return None


def _on_pci_bus(root: Path) -> bool:
    """Return True if there is a display controller (class 0x03) of NVIDIA (vendor 0x10de)."""
    with suppress(OSError):
        return any(
            vendor.read_text().strip() == "0x10de" and vendor.with_name("class").read_text()[:4] == "0x03"
            for vendor in (root / "sys/bus/pci/devices").glob("*/vendor")
        )
    return False


class Check(NamedTuple):
    """The result of one check of the self-test."""

    name: str
    faults: list[str]
    seconds: float | None = None
    """None: the test stopped in this check."""


class SelfTest(NamedTuple):
    """The result of a self-test."""

    facts: dict[str, str]
    """Facts on which the result depends: see `current_facts`."""
    checks: list[Check]
    gpu_ms: float = 0.0
    """Duration of a training step on the GPU, ms; 0 if it was not measured."""
    cpu_ms: float = 0.0
    keep: bool = True
    """False: the GPU's memory was full, or no GPU was visible. The next test may pass."""

    @property
    def fault(self) -> str | None:
        """The first fault in one line; None if the GPU passed."""
        return next((f"{check.name}: {fault}" for check in self.checks for fault in check.faults), None)

    @property
    def device(self) -> Literal["cpu", "cuda"]:
        """The device that ``--device auto`` chooses."""
        return "cuda" if self.fault is None and self.gpu_ms < self.cpu_ms else "cpu"

    @property
    def reason(self) -> str:
        """Reason why ``--device auto`` chooses `device`, in one line."""
        if self.fault is not None:
            return f"the GPU failed its self-test ({self.fault}); cleargs doctor --gpu repeats it"
        return f"{self.facts['gpu']} passed its self-test; {self._pace()}"

    def _pace(self) -> str:
        return f"a training step takes {self.gpu_ms:.3g} ms on the GPU, {self.cpu_ms:.3g} ms on the CPU"

    def lines(self) -> list[str]:
        """Return the whole result as text for an issue."""
        lines = [f"cleargs {cleargs.__version__}, Python {platform.python_version()}"]
        lines += [f"{name}: {value}" for name, value in self.facts.items()]
        for check in self.checks:
            seconds = "" if check.seconds is None else f", {check.seconds:.1f} s"
            lines.append(f"{check.name}: {'failed' if check.faults else 'passed'}{seconds}")
            lines += [f"  {fault}" for fault in check.faults]
        return [*lines, self._pace()] if self.gpu_ms else lines


def current_facts(root: Path = Path("/")) -> dict[str, str]:
    """Return the facts that decide a self-test's result: GPU, driver, versions, digest of kernel sources.

    Linux states GPU and driver in files below ``root``. If these are missing (WSL), nvidia-smi is called.
    """
    folder, text = root / "proc/driver/nvidia", ""
    with suppress(OSError):
        text = "".join(path.read_text() for path in sorted(folder.glob("gpus/*/information")))
        text += (folder / "version").read_text()
    names = re.findall(r"^Model:\s*(.+?)\s*$", text, re.MULTILINE)
    driver = re.search(r"^NVRM version:.*?(\d+\.\d+[.\d]*)", text, re.MULTILINE)
    gpu, number = ", ".join(names), driver[1] if driver else ""
    if not gpu or "Unknown" in gpu or not number:
        gpu, number = _from_nvidia_smi()
    if visible := os.environ.get("CUDA_VISIBLE_DEVICES"):
        gpu += f" (CUDA_VISIBLE_DEVICES={visible})"
    versions = {name: installed_version(name) for name in ("torch", "triton")}
    return {"gpu": gpu, "driver": number, **versions, "kernels": _kernel_digest()}


def _from_nvidia_smi() -> tuple[str, str]:
    command = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return "an NVIDIA GPU", "unknown"
    rows = [line.rsplit(", ", 1) for line in done.stdout.splitlines() if ", " in line]
    return ", ".join(row[0] for row in rows), rows[0][1] if rows else "unknown"


def _kernel_digest() -> str:
    """Return the digest of the sources of the GPU's kernels and of the self-test."""
    folder, digest = Path(__file__).parent / "splat", hashlib.sha256()
    sources = [folder / "constants.py", *folder.glob("kernels/*.py"), *folder.glob("kernels/cuda/*.py")]
    for source in sorted(sources):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def cached_test(facts: dict[str, str]) -> SelfTest | None:
    """Return the result of an earlier self-test with the same facts; None if there is none."""
    with suppress(*FAULTS):
        return read_result(facts, str(read_json(_cached(facts))["output"]))
    return None


def self_test(
    facts: dict[str, str],
    say: Callable[[str], None],
    *,
    command: Sequence[str] | None = None,
    limit_s: float = LIMIT_S,
) -> SelfTest:
    """Run the self-test, and store its result under ``facts`` (`current_facts`) in the user's cache folder.

    ``say`` receives a remark before the test starts. ``command`` starts the child process (by default the
    module `SELF_TEST`), which is ended after ``limit_s`` seconds.
    """
    say("testing the GPU (once per driver and version; it takes up to three minutes)")
    command = command or module_command(SELF_TEST)
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit_s, check=False)
        last = (done.stderr.strip().splitlines() or [""])[-1]
        end = f"ended by signal {-done.returncode}" if done.returncode < 0 else f"ended early: {last}"
        output, end = done.stdout, end if done.returncode else ""
    except subprocess.TimeoutExpired as expired:
        # bytes, in spite of text=True
        output, end = (expired.stdout or b"").decode(), f"not done after {limit_s:.0f} s"
    if end:
        output += "\n" + json.dumps({"stopped": end, "keep": True})
    result = read_result(facts, output)
    if result.keep:
        with suppress(StoreError):
            write_json(_cached(facts), {"facts": facts, "output": output})
    return result


class Machine(NamedTuple):
    """Functions that tell about the GPU of a machine, by default of this one."""

    obstacle: Callable[[], str | None] = cuda_obstacle
    facts: Callable[[], dict[str, str]] = current_facts
    cached_test: Callable[[dict[str, str]], SelfTest | None] = cached_test
    self_test: Callable[[dict[str, str], Callable[[str], None]], SelfTest] = self_test


def read_result(facts: dict[str, str], output: str) -> SelfTest:
    """Return the result in ``output``, the JSON lines that the child process printed."""
    result, running = SelfTest(facts, []), "start"
    for line in output.splitlines():
        with suppress(*FAULTS):
            found = json.loads(line)
            running = found.pop("starts", running)
            if "check" in found:
                result.checks.append(Check(found["check"], list(found["faults"]), float(found["seconds"])))
            elif "stopped" in found:
                result.checks.append(Check(running, [str(found["stopped"])]))
                result = result._replace(keep=found["keep"] is True)
            elif "gpu_ms" in found:
                result = result._replace(gpu_ms=float(found["gpu_ms"]), cpu_ms=float(found["cpu_ms"]))
    if not result.gpu_ms and result.fault is None:
        result.checks.append(Check(running, ["ended without a result"]))
    return result


def _cached(facts: dict[str, str]) -> Path:
    name = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]
    return cache_folder("gpu") / f"{name}.json"


if __name__ == "__main__":
    tested = self_test(current_facts(), lambda line: print(line, file=sys.stderr))
    print(*tested.lines(), sep="\n")
    sys.exit(tested.fault is not None)
