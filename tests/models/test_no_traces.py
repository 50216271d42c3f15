"""Libraries send nothing and leave no files, which some do by default."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

PROGRAM = """
from importlib.resources import files
from cleargs.capture.colmap import pycolmap
from cleargs.models.onnx import OnnxModel
pycolmap.logging.error("an error")
OnnxModel(files("cleargs.models") / "weights" / "scorer.onnx")
"""


def test_nothing_is_left_in_the_home_or_the_folder_of_temporary_files(tmp_path: Path) -> None:
    """onnxruntime writes a device's number into the home, and sends facts about itself and the computer."""
    environment = {"HOME": str(tmp_path), "TMPDIR": str(tmp_path), "PATH": "/usr/bin:/bin"}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "an error" in done.stderr
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
