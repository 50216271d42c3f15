"""``python -m benchmarks splat`` on a machine that has PyTorch and little else."""

from __future__ import annotations

import subprocess
import sys


def test_splat_needs_neither_pycolmap_nor_openimageio():
    """Rented machines with a GPU have PyTorch and little else."""
    program = (
        "import sys\n"
        "for name in ('pycolmap', 'OpenImageIO', 'av'): sys.modules[name] = None\n"
        "from benchmarks.commands import invoke\n"
        "sys.exit(invoke(['splat', '--help']))"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
