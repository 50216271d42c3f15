"""Where compiled kernels are kept, and compiling ahead of use."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from cleargs.splat.kernels import runtime


def test_cache_folder_is_named_by_the_sources(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = runtime.cache_folder()
    assert folder == tmp_path / f"kernels-{runtime.kernel_digest()}"
    assert folder.is_dir()


def test_digest_follows_every_kernel_source(monkeypatch):
    before = runtime.kernel_digest()
    read = Path.read_bytes
    for name in ("constants.py", "simd.py", "harmonics.py"):
        with monkeypatch.context() as patch:
            patch.setattr(Path, "read_bytes", lambda path, name=name: read(path) + b"#" * (path.name == name))
            assert runtime.kernel_digest() != before
    assert runtime.kernel_digest() == before


def test_cache_falls_back_to_a_temporary_folder(monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.touch()  # a file, so that no folder can be made below it, not even by root
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.setenv(name, str(blocked))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = runtime.cache_folder()
    assert folder.parent == tmp_path
    assert folder.name.startswith("cleargs-kernels-")


def test_warm_up_reports_every_kernel():
    seen = []
    runtime.warm_up(lambda name, done, total: seen.append((name, done, total)))
    total = len(seen) - 1
    assert total > 5
    assert [done for _, done, _ in seen] == list(range(total + 1))
    assert {n for _, _, n in seen} == {total}


def test_set_threads():
    from cleargs.splat.kernels.cpu import launch

    before = launch.threads()
    try:
        runtime.set_threads(1)
        assert launch.threads() == 1
        runtime.set_threads(10_000)
        assert launch.threads() >= 1
        with pytest.raises(ValueError, match="0 threads"):
            runtime.set_threads(0)
    finally:
        runtime.set_threads(before)


def test_importing_the_core_imports_neither_numba_nor_media_libraries():
    program = (
        "import sys, cleargs.splat.render, cleargs.splat.engine, cleargs.splat.losses, cleargs.splat.adam\n"
        "print([name for name in ('numba', 'pycolmap', 'OpenImageIO', 'cv2') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize("mode", [0o777, 0o775, 0o722])
def test_a_cache_that_others_may_write_to_is_passed_over(monkeypatch, tmp_path, mode):
    """What lies in it is run."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "shared"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    planted = runtime.cache_folder()
    assert planted.parent == tmp_path / "shared" and planted.stat().st_mode & 0o777 == 0o700
    planted.chmod(mode)
    assert runtime.cache_folder().parent == tmp_path / "own" / "cleargs"


def test_a_cache_of_somebody_else_is_passed_over(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "shared"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    planted = runtime.cache_folder()
    monkeypatch.setattr(runtime.os, "geteuid", lambda: planted.stat().st_uid + 1)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert not runtime.cache_folder().is_relative_to(tmp_path / "shared")


def test_a_link_is_no_cache(monkeypatch, tmp_path):
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared" / f"kernels-{runtime.kernel_digest()}").symlink_to(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "shared"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    assert runtime.cache_folder().parent == tmp_path / "own" / "cleargs"
