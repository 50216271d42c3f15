"""A small run for the tests of renders."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "evaluate"))

from eval_world import cameras, make_scene, write_run


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with six frames of 96x72 px and the scene of g0. Tests do not change it."""
    return write_run(tmp_path_factory.mktemp("render") / "run", make_scene(), cameras())
