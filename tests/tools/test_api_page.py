"""docs/api.md is up to date with the docstrings."""

from pathlib import Path

from tools.api_page import page

ROOT = Path(__file__).parents[2]


def test_page_is_current() -> None:
    """The command ``python -m tools.api_page > docs/api.md`` updates it."""
    assert page() == (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
