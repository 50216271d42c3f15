"""The folder of compiled kernels."""

from __future__ import annotations

import os
import tempfile
from types import SimpleNamespace

import torch

from cleargs.kernel_cache import cache_folder, installation
from cleargs.progress import COMPILING, LineReporter
from cleargs.splat.trainer import Trainer


def test_cache_falls_back_to_a_temporary_folder(monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.touch()  # a file, so that even root cannot create a folder in it
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.setenv(name, str(blocked))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = cache_folder("kernels")
    assert folder.parent == tmp_path
    assert folder.name.startswith("cleargs-kernels-")


def test_cache_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "chosen"))
    assert cache_folder("kernels") == tmp_path / "chosen" / "kernels"
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    assert cache_folder("kernels") == tmp_path / "own" / "cleargs" / "kernels"


def test_another_installation_compiles_again(monkeypatch, tmp_path):
    """Numba's cache is one per place and time of the sources. Once, this was a silent minute."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    source = tmp_path / "splat/kernels/cpu/loss.py"
    source.parent.mkdir(parents=True)
    source.touch()
    before = installation()
    said: list[str] = []
    trainer = SimpleNamespace(
        _device=torch.device("cpu"), _backend=SimpleNamespace(warm_up=lambda: said.append("compiled"))
    )
    reporter = LineReporter(said.append, said.append, said.append)
    Trainer._warm_up(trainer, reporter)
    Trainer._warm_up(trainer, reporter)
    assert said[0] == f"{COMPILING}: started" and said[1] == "compiled", "announced before it is silent"
    assert said[2].startswith(f"{COMPILING}: done in") and said[3:] == ["compiled"]
    monkeypatch.setattr("cleargs.kernel_cache.__file__", str(tmp_path / "kernel_cache.py"))
    elsewhere = installation()
    os.utime(source, ns=(1, 1))
    assert len({before, elsewhere, installation()}) == 3
    Trainer._warm_up(trainer, reporter)
    assert said[4] == f"{COMPILING}: started"
