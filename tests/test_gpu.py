"""The GPU as far as it is known without torch, and the results of self-tests."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from cleargs import gpu

CHECKS = '{"starts": "Adam"}\n{"check": "Adam", "faults": [], "seconds": 0.5}\n'
FAST = '{"gpu_ms": 2.0, "cpu_ms": 50.0}\n'
FACTS = {"gpu": "NVIDIA A1", "driver": "550.54.15", "torch": "2.11.0", "triton": "3.6.0", "kernels": "00ff"}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of cached results."""
    monkeypatch.setattr(gpu, "cache_folder", lambda name: tmp_path)
    return tmp_path


def run_child(code: str) -> gpu.SelfTest:
    """Run the Python text ``code`` in place of the self-test."""
    return gpu.self_test(FACTS, lambda line: None, command=[sys.executable, "-c", code])


def prints(text: str) -> str:
    return f"print({text!r}, end='')"


def test_a_fast_gpu_that_passes_is_taken() -> None:
    result = run_child(prints(CHECKS + FAST))
    assert result.device == "cuda"
    assert result.reason == (
        "NVIDIA A1 passed its self-test; a training step takes 2 ms on the GPU, 50 ms on the CPU"
    )
    assert gpu.cached_test(FACTS) == result
    assert result.lines()[-2:] == [
        "Adam: passed, 0.5 s",
        "a training step takes 2 ms on the GPU, 50 ms on the CPU",
    ]
    assert "driver: 550.54.15" in result.lines()


def test_a_slow_gpu_is_not() -> None:
    result = run_child(prints(CHECKS + FAST.replace("50.0", "1.5")))
    assert (result.fault, result.device) == (None, "cpu")
    assert result.reason.endswith("takes 2 ms on the GPU, 1.5 ms on the CPU")


@pytest.mark.parametrize("fact", FACTS)
def test_a_result_belongs_to_all_of_its_facts(fact: str) -> None:
    run_child(prints(CHECKS + FAST))
    assert gpu.cached_test({**FACTS, fact: "another"}) is None


def test_a_failed_check_keeps_the_gpu_out() -> None:
    failed = CHECKS.replace("[]", '["means: differs by 1", "sh: differs by 2"]')
    result = run_child(prints(failed + FAST))
    assert result.device == "cpu"
    assert result.reason == (
        "the GPU failed its self-test (Adam: means: differs by 1); cleargs doctor --gpu repeats it"
    )
    assert result.lines()[-4:-1] == ["Adam: failed, 0.5 s", "  means: differs by 1", "  sh: differs by 2"]
    assert gpu.cached_test(FACTS) == result


@pytest.mark.parametrize(
    ("code", "fault"),
    [
        (prints(CHECKS), "Adam: ended without a result"),
        ("", "start: ended without a result"),
        (
            prints("no JSON\n[1]\n" + CHECKS) + "; raise SystemExit('broken wheel')",
            "Adam: ended early: broken wheel",
        ),
        ("import os; os.abort()", "start: ended by signal 6"),
    ],
)
def test_a_child_that_breaks_off(code: str, fault: str) -> None:
    assert run_child(code).fault == fault


def test_a_full_memory_is_tested_again() -> None:
    stopped = json.dumps({"stopped": "the GPU's memory is full: 1 of 24 GiB free", "keep": False})
    assert not run_child(prints(CHECKS + stopped)).keep
    assert gpu.cached_test(FACTS) is None


def test_a_damaged_result_counts_as_none(cache: Path) -> None:
    run_child(prints(CHECKS + FAST))
    (file,) = cache.iterdir()
    file.write_text("{")
    assert gpu.cached_test(FACTS) is None


# -- this machine ------------------------------------------------------------------------------------------


def test_facts_of_linux(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "proc/driver/nvidia"
    for bus, model in (("0000:01:00.0", "NVIDIA A1"), ("0000:02:00.0", "NVIDIA B2")):
        (folder / "gpus" / bus).mkdir(parents=True)
        (folder / "gpus" / bus / "information").write_text(f"Model: \t\t {model}\nIRQ:   \t\t 57\n")
    (folder / "version").write_text(
        "NVRM version: NVIDIA UNIX x86_64 Kernel Module  550.54.15  Tue Mar  5 22:23:56 UTC 2024\n"
        "GCC version:  gcc version 12.2.0 (Debian 12.2.0-14)\n"
    )
    monkeypatch.setattr(gpu, "installed_version", {"torch": "2.11.0", "triton": "3.6.0"}.__getitem__)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    facts = gpu.current_facts(tmp_path)
    assert (facts["gpu"], facts["driver"]) == ("NVIDIA A1, NVIDIA B2", "550.54.15")
    assert (facts["torch"], len(facts["kernels"])) == ("2.11.0", 16)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    assert gpu.current_facts(tmp_path)["gpu"].endswith("B2 (CUDA_VISIBLE_DEVICES=1)")


@pytest.mark.parametrize(
    ("script", "expected"),
    [
        ("echo 'NVIDIA A1, 550.54.15'", ("NVIDIA A1", "550.54.15")),
        ("echo 'NVIDIA-SMI has failed'; exit 9", ("an NVIDIA GPU", "unknown")),
        (None, ("an NVIDIA GPU", "unknown")),
    ],
)
def test_facts_where_linux_does_not_tell(
    script: str | None, expected: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if script is not None:
        (tmp_path / "nvidia-smi").write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / "nvidia-smi").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(gpu, "installed_version", {"torch": "2.11.0", "triton": "3.6.0"}.__getitem__)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    facts = gpu.current_facts(tmp_path)
    assert (facts["gpu"], facts["driver"]) == expected


def test_obstacles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    assert gpu.cuda_obstacle(tmp_path) == gpu.NO_GPU
    device = tmp_path / "sys/bus/pci/devices/0000:01:00.0"
    device.mkdir(parents=True)
    (device / "vendor").write_text("0x10de\n")
    (device / "class").write_text("0x040300\n")  # the sound of a GPU
    assert gpu.cuda_obstacle(tmp_path) == gpu.NO_GPU
    (device / "class").write_text("0x030000\n")
    assert "driver is not loaded" in str(gpu.cuda_obstacle(tmp_path))
    (tmp_path / "dev").mkdir()
    (tmp_path / "dev/nvidiactl").touch()
    monkeypatch.setattr(gpu, "find_spec", lambda name: None)
    assert "Triton" in str(gpu.cuda_obstacle(tmp_path))
    monkeypatch.setattr(gpu, "find_spec", lambda name: object())
    monkeypatch.setattr(gpu, "version", lambda name: "2.13.0+cpu")
    assert "CPU only" in str(gpu.cuda_obstacle(tmp_path))
    monkeypatch.setattr(gpu, "version", lambda name: "2.13.0")
    assert gpu.cuda_obstacle(tmp_path) is None
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "-1")
    assert gpu.cuda_obstacle(tmp_path) == gpu.NO_GPU


def test_the_self_test_needs_neither_pycolmap_nor_pydantic() -> None:
    """A machine for a test may have PyTorch, Triton, Numba and SciPy only."""
    absent = ("pycolmap", "OpenImageIO", "pydantic", "pyarrow", "cv2", "safetensors", "click", "rich")
    needed = ["cleargs.gpu", "cleargs.splat.kernels.cpu.backend"]
    if importlib.util.find_spec("triton"):
        needed += ["cleargs.splat.kernels.cuda.self_test", "cleargs.splat.kernels.cuda.backend"]
    code = f"import sys; sys.modules.update(dict.fromkeys({absent})); import {', '.join(needed)}"
    subprocess.run([sys.executable, "-c", code], check=True)
