"""The page of a batch in a real browser, wide and on a phone, light and dark."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.chromium import CHROMIUM, NO_CHROMIUM, SIZES, Opened, check_page
from made_pages import batch_page

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return batch_page(tmp_path_factory.mktemp("batch"))


@pytest.mark.parametrize("size", SIZES)
def test_page_fits_its_screen(browser: Any, made: Path, size: str) -> None:
    check_page(browser, made.as_uri(), size)


def test_scenes_are_filtered_by_their_state(browser: Any, made: Path) -> None:
    page = browser.new_page(viewport=SIZES["wide"])
    opened = Opened(page, made.as_uri())
    page.locator('#filters [data-kind="failed"]').press("Enter")
    assert page.locator("#strip li:visible b").first.inner_text() == "cellar"
    assert page.locator("#strip li:visible").count() == 1
    page.locator('#filters [data-kind=""]').click()
    page.get_by_role("link", name="Report of attic").click()
    assert page.url.endswith("/scenes/attic/report/index.html") and opened.network_requests() == []
    page.close()
