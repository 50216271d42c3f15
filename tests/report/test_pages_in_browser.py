"""The page of a batch in a real browser, wide and on a phone, light and dark."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.chromium import CHROMIUM, NO_CHROMIUM, Opened
from made_pages import batch_page

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)]

SIZES = {"wide": {"width": 1280, "height": 900}, "phone": {"width": 390, "height": 844}}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return batch_page(tmp_path_factory.mktemp("batch"))


@pytest.fixture(params=SIZES)
def size(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def opened(made: Path, browser: Any, size: str) -> Iterator[Opened]:
    scheme = "light" if size == "wide" else "dark"
    page = browser.new_page(viewport=SIZES[size], color_scheme=scheme)
    yield Opened(page, made.as_uri())
    page.close()


def test_a_page_fits_its_screen_and_asks_for_nothing_else(opened: Opened, size: str) -> None:
    page = opened.page
    page.evaluate("for (const image of document.images) image.loading = 'eager'")
    page.wait_for_function("[...document.images].every((image) => !image.src || image.naturalWidth > 50)")
    assert page.evaluate("document.documentElement.scrollWidth") == SIZES[size]["width"]
    assert opened.complaints == [] and opened.strangers() == []
    assert page.evaluate("window.hacked") is None


def test_scenes_are_told_apart_by_their_state(browser: Any, made: Path) -> None:
    page = browser.new_page(viewport=SIZES["wide"])
    opened = Opened(page, made.as_uri())
    page.locator('#filters [data-kind="failed"]').press("Enter")
    assert page.locator("#strip li:visible b").first.inner_text() == "cellar"
    assert page.locator("#strip li:visible").count() == 1
    page.locator('#filters [data-kind=""]').click()
    page.get_by_role("link", name="Report of attic").click()
    assert page.url.endswith("/scenes/attic/report/index.html") and opened.strangers() == []
    page.close()
