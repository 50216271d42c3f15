"""Rules for the figures and pictures of the pages."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_no_figure_is_of_a_checkout_with_uncommitted_changes() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.json")]
    assert [page.name for page in pages if "-dirty," in page.read_text(encoding="utf-8")] == []


def test_front_pages_have_places_for_generated_tables() -> None:
    for page, names in (("README.md", ["real"]), ("docs/results.md", ["real", "faults"])):
        text = (ROOT / page).read_text(encoding="utf-8")
        assert all(f"<!-- {name} -->\n\n| " in text for name in names), page


def test_readme_and_results_stay_short() -> None:
    """Readers see the answer on one screen; details have separate pages."""
    for page, lines in (("README.md", 60), ("docs/results.md", 70), ("CHANGELOG.md", 120)):
        assert len((ROOT / page).read_text(encoding="utf-8").splitlines()) <= lines, page


def test_pictures_of_the_guide_are_small_and_shown() -> None:
    pages = " ".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("*.md"))
    for picture in (ROOT / "docs/guide").iterdir():
        assert picture.stat().st_size < 200_000, picture.name
        assert f"guide/{picture.name}" in pages, picture.name
