"""Where compiled kernels lie: what is found there is run."""

from __future__ import annotations

import tempfile

import pytest

from cleargs import kernel_cache
from cleargs.kernel_cache import cache_folder


def test_cache_falls_back_to_a_temporary_folder(monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.touch()  # a file, so that no folder can be made below it, not even by root
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.setenv(name, str(blocked))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = cache_folder("kernels")
    assert folder.parent == tmp_path
    assert folder.name.startswith("cleargs-kernels-")


@pytest.mark.parametrize("mode", [0o777, 0o775, 0o722])
def test_a_cache_that_others_may_write_to_is_passed_over(monkeypatch, tmp_path, mode):
    """What lies in it is run."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "shared"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    planted = cache_folder("kernels")
    assert planted.parent == tmp_path / "shared" and planted.stat().st_mode & 0o777 == 0o700
    planted.chmod(mode)
    assert cache_folder("kernels").parent == tmp_path / "own" / "cleargs"


def test_a_cache_in_a_folder_where_others_may_rename_is_passed_over(monkeypatch, tmp_path):
    """They could put one of their own in its place after it was looked at."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "shared"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared").chmod(0o777)
    assert cache_folder("kernels").parent == tmp_path / "own" / "cleargs"
    (tmp_path / "shared").chmod(0o1777)
    assert cache_folder("kernels").parent == tmp_path / "shared"


def test_a_cache_of_somebody_else_is_passed_over(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "shared"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    planted = cache_folder("kernels")
    monkeypatch.setattr(kernel_cache.os, "geteuid", lambda: planted.stat().st_uid + 1)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert not cache_folder("kernels").is_relative_to(tmp_path / "shared")


def test_a_link_is_no_cache(monkeypatch, tmp_path):
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared" / "kernels").symlink_to(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "shared"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    assert cache_folder("kernels").parent == tmp_path / "own" / "cleargs"
