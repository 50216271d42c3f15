"""Pages from disk in a real browser: Debian's Chromium, with WebGL in software."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

sync_api = pytest.importorskip("playwright.sync_api", reason="the extra `browser` is not installed")
CHROMIUM = shutil.which("chromium")
NO_CHROMIUM = "there is no chromium (apt-get install chromium)"

TIMEOUT_MS = 240_000  # software WebGL on a busy machine
ALLOWED = ("file:", "data:", "blob:")
SIZES: dict[str, Any] = {"wide": {"width": 1280, "height": 900}, "phone": {"width": 390, "height": 844}}
FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-sandbox")


@contextmanager
def chromium() -> Iterator[Any]:
    """Start the browser."""
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield browser
        browser.close()


class Opened:
    """A page in the browser, with its errors, warnings and requests."""

    def __init__(self, page: Any, address: str) -> None:
        self.page = page
        self.complaints: list[str] = []
        self.requests: list[str] = []
        page.set_default_timeout(TIMEOUT_MS)
        page.on("console", self._heard)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", lambda request: self.requests.append(request.url))
        page.goto(address)

    def _heard(self, message: Any) -> None:
        if message.type in ("error", "warning"):
            self.complaints.append(message.text)

    def network_requests(self) -> list[str]:
        """URLs that the page requested and that are not files next to it."""
        return [url for url in self.requests if not url.startswith(ALLOWED)]


def check_page(browser: Any, address: str, size: str) -> None:
    """Assert that a page fits its screen, shows its images, and requests nothing from a network."""
    scheme = "light" if size == "wide" else "dark"
    page = browser.new_page(viewport=SIZES[size], color_scheme=scheme)
    opened = Opened(page, address)
    page.evaluate("for (const image of document.images) image.loading = 'eager'")
    page.wait_for_function("[...document.images].every((image) => !image.src || image.naturalWidth > 50)")
    assert page.evaluate("document.documentElement.scrollWidth") == SIZES[size]["width"]
    assert opened.complaints == [] and opened.network_requests() == []
    assert page.evaluate("window.hacked") is None
    page.close()
