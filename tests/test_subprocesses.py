"""Child processes never import modules from the working folder."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import cleargs
from cleargs.capture.child import run_child
from cleargs.errors import StageError
from cleargs.progress import SilentReporter

HOSTILE = ["pycolmap.py", "json.py", "numpy.py", "cleargs/__init__.py"]


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Path:
    """A working folder with a module that creates a file when it is imported; the path of that file."""
    mark = tmp_path / "imported"
    module = tmp_path / "capture" / request.param
    module.parent.mkdir(parents=True)
    module.write_text(f"open({str(mark)!r}, 'w').close()\nraise SystemExit(9)\n")
    monkeypatch.chdir(tmp_path / "capture")
    return mark


@pytest.mark.parametrize("trap", HOSTILE, indirect=True)
def test_children_import_nothing_from_the_working_folder(trap: Path, tmp_path: Path) -> None:
    with pytest.raises(StageError):  # the job does not exist, which the child notices after its imports
        run_child("cleargs.capture.sfm_worker", tmp_path / "no.json", tmp_path / "log", SilentReporter())
    assert "no.json" in (tmp_path / "log").read_text()
    assert not trap.exists()


def test_every_module_is_started_by_module_command() -> None:
    for file in Path(cleargs.__file__).parent.rglob("*.py"):
        if file.name != "subprocesses.py":
            assert not re.search(r"sys\.executable[^\n]*\"-m\"", file.read_text()), file
