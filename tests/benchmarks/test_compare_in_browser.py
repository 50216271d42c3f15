"""The page of a comparison in a browser: wide and phone screens, light and dark."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from compared_runs import HOSTILE, compare_runs
from helpers.chromium import CHROMIUM, NO_CHROMIUM, SIZES, Opened, check_page

from benchmarks.comparison.page import write_comparison

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out, compared = compare_runs(tmp_path_factory.mktemp("compare"))
    return write_comparison(out, compared, [HOSTILE], [HOSTILE], [HOSTILE])


@pytest.mark.parametrize("size", SIZES)
def test_page_fits_its_screen(browser: Any, made: Path, size: str) -> None:
    check_page(browser, made.as_uri(), size)


def test_pose_opens_with_slider_by_keyboard(browser: Any, made: Path) -> None:
    page = browser.new_page(viewport=SIZES["wide"])
    opened = Opened(page, made.as_uri())
    page.locator(".tile").nth(1).press("Enter")
    assert page.locator("#inspector").is_visible()
    assert page.locator("#tag-left").inner_text() == "Reference"
    assert page.locator("#tag-right").inner_text() == HOSTILE
    first = page.locator("#inspector-title").inner_text()
    page.locator("#slider").focus()
    page.keyboard.press("ArrowLeft")
    assert page.evaluate("document.querySelector('.overlay').style.getPropertyValue('--cut')") == "49%"
    page.locator(".close").focus()
    page.keyboard.press("ArrowRight")
    title = page.locator("#inspector-title").inner_text()
    assert title != first
    assert page.locator("#tag-right").inner_text() == HOSTILE, "the variant stays from pose to pose"
    assert page.locator("#right").get_attribute("alt") == f"{title}: {HOSTILE}"
    page.keyboard.press("Escape")
    assert not page.locator("#inspector").is_visible() and opened.complaints == []
    page.close()
