"""docs/api.md is up to date with the docstrings."""

from pathlib import Path

from tools.api_page import page, section

ROOT = Path(__file__).parents[2]


def test_page_is_current() -> None:
    """The command ``python -m tools.api_page > docs/api.md`` updates it."""
    assert page() == (ROOT / "docs" / "api.md").read_text(encoding="utf-8")


def test_sections_of_a_docstring_become_markdown() -> None:
    text = section("evaluate_scene")
    assert "**Args**\n\n* `scene`: A run or its folder, a scene or a PLY file. " in text
    assert "**Example**\n\n```python\n" in text and text.rstrip().endswith("```")
