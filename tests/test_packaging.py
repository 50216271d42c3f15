"""What gets installed is what lies in the checkout."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_every_package_is_listed() -> None:
    """setuptools cannot find packages through ``package-dir``, so they are listed by hand."""
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    own = [path.parent.relative_to(ROOT) for path in (ROOT / "cleargs").rglob("__init__.py")]
    assert sorted(listed) == sorted(
        [".".join(p.parts) for p in own] + ["cleargs.stages", "cleargs.workflows"]
    )


def test_the_splatting_core_needs_no_capture_libraries() -> None:
    """Machines that only train have neither pycolmap nor OpenImageIO."""
    code = (
        "import sys; sys.modules.update({'pycolmap': None, 'OpenImageIO': None});"
        "import cleargs.splat.trainer, cleargs.splat.render, cleargs.splat.ply, cleargs.splat.engine"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_command_line_starts_without_heavy_imports() -> None:
    code = (
        "import sys, cleargs.cli.main, cleargs.stages, cleargs.cli.run;"
        "from importlib import import_module;"
        "[import_module('cleargs.stages.' + name) for name in cleargs.stages.STAGES];"
        "heavy = {'torch', 'numba', 'pycolmap', 'cv2', 'onnxruntime', 'OpenImageIO'};"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
