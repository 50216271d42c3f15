"""A stage whose source changed must have a new VERSION."""

from __future__ import annotations

import textwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cleargs.pipeline.dag import Dag, installed
from cleargs.pipeline.stage import Stage
from tools.versions import (
    Sources,
    complaints,
    current_lock,
    installed_sources,
    lock_path,
    read_lock,
    updated_lock,
)


def test_no_stage_changed_without_its_version() -> None:
    sources = installed_sources()
    locked, now = read_lock(lock_path(sources)), current_lock(installed(), sources)
    assert complaints(locked, now) == [], "raise VERSION, or say why results stay the same; see the module"
    digests = [{name: entry["digest"] for name, entry in lock.items()} for lock in (locked, now)]
    assert digests[0] == digests[1], "refresh the lock: python -m tools.versions --update"


def test_real_stages_reach_their_rooms() -> None:
    sources = installed_sources()
    modules = sources.closure("cleargs.stages.rva")
    assert "cleargs.rva.config" in modules, "imported at the top"
    assert "cleargs.parquet" in modules, "imported inside run"
    assert not any(name.startswith("cleargs.cli") for name in modules)


class House:
    """A small package tree with one stage."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.version = 1
        self.write(
            "stages/one.py", "VERSION = 1\ndef run(c):\n    from cleargs.room.work import go\n    go()\n"
        )
        self.write("cleargs/__init__.py", '"""Top."""\n')
        self.write("cleargs/room/__init__.py", "")
        self.write("cleargs/room/work.py", 'from . import helper\nCHILD = "cleargs.child"\n')
        self.write("cleargs/room/helper.py", '"""Help."""\nX = 1\n"""What X is."""\n')
        self.write("cleargs/child.py", "from cleargs.cli.main import main\nY = 1\n")
        self.write("cleargs/cli/main.py", "Z = 1\n")
        self.write("cleargs/other.py", "W = 1\n")

    def write(self, name: str, text: str) -> None:
        file = self.root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(textwrap.dedent(text))

    def lock(self) -> dict[str, dict[str, Any]]:
        sources = Sources({"cleargs": self.root / "cleargs", "cleargs.stages": self.root / "stages"})
        stage = cast(Stage, SimpleNamespace(VERSION=self.version))
        return current_lock(Dag(("one",), lambda name: stage), sources)


@pytest.fixture
def house(tmp_path: Path) -> House:
    return House(tmp_path)


def test_source_is_all_that_is_imported(house: House) -> None:
    assert set(house.lock()["one"]["modules"]) == {
        "cleargs",
        "cleargs.child",
        "cleargs.room",
        "cleargs.room.helper",
        "cleargs.room.work",
        "cleargs.stages.one",
    }


@pytest.mark.parametrize(
    ("name", "text", "counts"),
    [
        ("cleargs/room/helper.py", "X = 2\n", True),
        ("cleargs/room/helper.py", '"""Help!"""\n# why\nX   =   1\n"""What X really is."""\n', False),
        ("cleargs/child.py", "from cleargs.cli.main import main\nY = 2\n", True),
        ("cleargs/cli/main.py", "Z = 2\n", False),
        ("cleargs/other.py", "W = 2\n", False),
    ],
)
def test_what_counts_as_a_change(house: House, name: str, text: str, counts: bool) -> None:
    before = house.lock()
    house.write(name, text)
    assert (house.lock()["one"]["digest"] != before["one"]["digest"]) == counts


def test_lock_is_refreshed_only_with_a_version_or_a_reason(house: House) -> None:
    before = updated_lock({}, house.lock(), None)
    house.write("cleargs/room/helper.py", "X = 2\n")
    with pytest.raises(
        ValueError, match=r"one: VERSION is still 1, but these changed: cleargs\.room\.helper"
    ):
        updated_lock(before, house.lock(), None)
    reasoned = updated_lock(before, house.lock(), "X is not used")
    assert reasoned["one"]["unchanged_because"] == "X is not used"
    assert complaints(reasoned, house.lock()) == []
    house.version = 2
    assert updated_lock(before, house.lock(), None)["one"]["version"] == 2
    later = house.lock()
    house.version = 1
    with pytest.raises(ValueError, match="VERSION fell from 2 to 1"):
        updated_lock(later, house.lock(), "no reason is good enough")
