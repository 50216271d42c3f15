"""Links that `make docs` does not check: those of pages outside docs/, and names of pages in the source."""

from __future__ import annotations

import re
from pathlib import Path
from pkgutil import resolve_name
from typing import get_args

import pytest

from cleargs.plugins import ExtensionPoint

ROOT = Path(__file__).parents[1]
PAGES = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "data/README.md",
    "findings/README.md",
    "cleargs/models/weights/README.md",
]
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)\s]*)?\)")
NAMED_FILE = re.compile(r"`((?:cleargs|stages|tests|tools|benchmarks|examples|workflows)/[\w./-]+\.\w+)`")
NAMED_OBJECT = re.compile(r"`(cleargs(?:\.\w+)+)`")
GROUPS = {f"cleargs.{point}" for point in get_args(ExtensionPoint)}
"""Groups of entry points: names without a module."""
NAMED_PAGE = re.compile(r"\bdocs/[\w/-]+\.(?:md|png|svg)\b")


@pytest.mark.parametrize("page", PAGES)
def test_relative_links_lead_somewhere(page: str) -> None:
    found = [link for link in LINK.findall((ROOT / page).read_text("utf-8")) if "://" not in link]
    assert [link for link in found if not (ROOT / page).parent.joinpath(link).exists()] == []


def test_pages_named_in_the_source_exist() -> None:
    places = [
        path for room in ("cleargs", "stages", "workflows", "tests") for path in (ROOT / room).rglob("*")
    ]
    named = {
        (name, path.relative_to(ROOT).as_posix())
        for path in places
        if path.suffix in (".py", ".toml", ".md")
        for name in NAMED_PAGE.findall(path.read_text("utf-8"))
    }
    assert {name for name, _ in named} >= {"docs/settings.md", "docs/results.md"}
    assert [(name, where) for name, where in sorted(named) if not (ROOT / name).exists()] == []


@pytest.mark.parametrize(
    "page", ["CONTRIBUTING.md", *(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]
)
def test_files_and_objects_named_on_a_page_exist(page: str) -> None:
    """docs/developers.md sent its readers to a class that did not exist."""
    text = (ROOT / page).read_text("utf-8")
    assert [name for name in NAMED_FILE.findall(text) if not (ROOT / name).exists()] == []
    for name in set(NAMED_OBJECT.findall(text)) - GROUPS:
        resolve_name(name)
