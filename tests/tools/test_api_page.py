"""The page of the library is what its docstrings say."""

from pathlib import Path

from tools.api_page import page

ROOT = Path(__file__).parents[2]


def test_page_is_current() -> None:
    """Made by: python -m tools.api_page > docs/api.md"""
    assert page() == (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
