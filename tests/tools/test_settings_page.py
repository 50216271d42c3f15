"""docs/settings.md is up to date with the models of the settings."""

from pathlib import Path

from tools.settings_page import FIRST, page


def test_page_is_current() -> None:
    """The command ``python -m tools.settings_page > docs/settings.md`` updates it."""
    assert page() == (Path(__file__).parents[2] / "docs" / "settings.md").read_text(encoding="utf-8")


def test_twelve_settings_come_first() -> None:
    assert len(FIRST) == 12
    head = page().partition("## All settings")[0]
    assert all(f"| `{name}` |" in head for name in FIRST)
