"""A stage whose source changed must have a new VERSION."""

from __future__ import annotations

import textwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cleargs.pipeline.stage import Stage
from cleargs.pipeline.stages import Stages, installed
from tools.versions import (
    NO_RESULTS,
    Sources,
    current_lock,
    installed_sources,
    lock_path,
    read_lock,
    updated_lock,
    violations,
)


def test_no_stage_changed_without_its_version() -> None:
    sources = installed_sources()
    locked, now = read_lock(lock_path(sources)), current_lock(installed(), sources)
    assert violations(locked, now) == [], (
        "increase VERSION, or give a reason why results stay the same (tools/versions.py)"
    )
    digests = [{name: entry["digest"] for name, entry in lock.items()} for lock in (locked, now)]
    assert digests[0] == digests[1], "update the lock: python -m tools.versions --update"


def test_source_of_a_real_stage_has_its_imports() -> None:
    sources = installed_sources()
    modules = sources.closure("cleargs.stages.rva")
    assert "cleargs.rva.config" in modules, "imported at the top"
    assert "cleargs.parquet" in modules, "imported inside run"
    assert not any(f"{name}.".startswith(f"{other}.") for name in modules for other in NO_RESULTS)


def test_modules_without_results_exist() -> None:
    assert all(installed_sources().file(name) for name in NO_RESULTS)


class PackageTree:
    """A small package tree with one stage."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.version = 1
        self.write(
            "stages/one.py",
            """
            VERSION = 1
            def estimate(c):
                from cleargs.other import W
                return W
            def run(c):
                from cleargs.package.work import go
                go()
            """,
        )
        self.write("cleargs/__init__.py", '"""Top."""\n')
        self.write("cleargs/package/__init__.py", "")
        self.write("cleargs/package/work.py", 'from . import helper\nCHILD = "cleargs.child"\n')
        self.write("cleargs/package/helper.py", '"""Help."""\nX = 1\n"""What X is."""\n')
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
        return current_lock(Stages(("one",), lambda name: stage), sources)


@pytest.fixture
def tree(tmp_path: Path) -> PackageTree:
    return PackageTree(tmp_path)


def test_estimates_are_no_part_of_the_source(tree: PackageTree) -> None:
    before = tree.lock()
    stage = tree.root / "stages" / "one.py"
    stage.write_text(stage.read_text().replace("return W", "return 2 * W"))
    assert violations(before, tree.lock()) == []


def test_source_is_all_that_is_imported(tree: PackageTree) -> None:
    assert set(tree.lock()["one"]["modules"]) == {
        "cleargs",
        "cleargs.child",
        "cleargs.package",
        "cleargs.package.helper",
        "cleargs.package.work",
        "cleargs.stages.one",
    }


@pytest.mark.parametrize(
    ("name", "text", "counts"),
    [
        ("cleargs/package/helper.py", "X = 2\n", True),
        ("cleargs/package/helper.py", '"""Help!"""\n# why\nX   =   1\n"""What X really is."""\n', False),
        ("cleargs/child.py", "from cleargs.cli.main import main\nY = 2\n", True),
        ("cleargs/cli/main.py", "Z = 2\n", False),
        ("cleargs/other.py", "W = 2\n", False),
    ],
)
def test_what_counts_as_a_change(tree: PackageTree, name: str, text: str, counts: bool) -> None:
    before = tree.lock()
    tree.write(name, text)
    assert (tree.lock()["one"]["digest"] != before["one"]["digest"]) == counts


def test_lock_is_refreshed_only_with_a_version_or_a_reason(tree: PackageTree) -> None:
    before = updated_lock({}, tree.lock(), None)
    tree.write("cleargs/package/helper.py", "X = 2\n")
    with pytest.raises(
        ValueError, match=r"one: VERSION is still 1, but these changed: cleargs\.package\.helper"
    ):
        updated_lock(before, tree.lock(), None)
    reasoned = updated_lock(before, tree.lock(), "X is not used")
    assert reasoned["one"]["unchanged_because"] == "X is not used"
    assert violations(reasoned, tree.lock()) == []
    tree.version = 2
    assert updated_lock(before, tree.lock(), None)["one"]["version"] == 2
    later = tree.lock()
    tree.version = 1
    with pytest.raises(ValueError, match="VERSION decreased from 2 to 1"):
        updated_lock(later, tree.lock(), "not accepted")
