"""The cache of compiled kernels, the number of threads, and the imports of the core."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from numba import config

from cleargs.splat.backend import set_threads
from cleargs.splat.kernels.cpu import jit


def test_the_cache_is_named_by_the_sources(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(config, "CACHE_DIR", config.CACHE_DIR)  # restored at the end
    jit.configure_numba()
    assert Path(config.CACHE_DIR) == tmp_path / f"kernels-{jit.kernel_digest()}"
    assert Path(config.CACHE_DIR).is_dir()


def test_digest_follows_every_kernel_source(monkeypatch):
    before = jit.kernel_digest()
    read = Path.read_bytes
    for name in ("constants.py", "simd.py", "harmonics.py", "splat_layout.py", "warp_layout.py"):
        with monkeypatch.context() as patch:
            patch.setattr(Path, "read_bytes", lambda path, name=name: read(path) + b"#" * (path.name == name))
            assert jit.kernel_digest() != before
    assert jit.kernel_digest() == before


def test_set_threads():
    import numba

    before = numba.get_num_threads()
    try:
        set_threads(1)
        assert numba.get_num_threads() == 1
        set_threads(10_000)
        assert numba.get_num_threads() >= 1
        with pytest.raises(ValueError, match="0 threads"):
            set_threads(0)
    finally:
        set_threads(before)


def test_core_imports_neither_numba_nor_media_libraries():
    program = (
        "import sys, cleargs.splat.render, cleargs.splat.backend, cleargs.splat.types\n"
        "print([name for name in ('numba', 'pycolmap', 'OpenImageIO', 'cv2') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
