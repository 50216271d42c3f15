"""The page of the settings is made from their models."""

from pathlib import Path

from tools.settings_page import page


def test_the_page_of_settings_is_current() -> None:
    """Made by: python -m tools.settings_page > docs/settings.md"""
    assert page() == (Path(__file__).parents[2] / "docs" / "settings.md").read_text(encoding="utf-8")
