"""A parser of pages, and checks that tests of pages share."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path


class Page(HTMLParser):
    """Elements of a page: (tag, attributes), and the text in all."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def links(page: Page) -> list[str]:
    """All URLs that the page loads or links to."""
    return [
        value
        for _, attributes in page.elements
        for name, value in attributes.items()
        if name in ("src", "href") and value
    ]


def assert_offline(page: Path) -> None:
    """Assert that a page loads nothing from a network, and that all its files exist."""
    parsed, text = Page(page.read_text()), page.read_text()
    assert not [link for link in links(parsed) if re.match(r"(https?:)?//", link)]
    style = re.search(r"<style>(.*?)</style>", text, re.S)[1]
    assert "url(" not in style and "@import" not in style
    assert not [link for link in links(parsed) if link[0] != "#" and not (page.parent / link).exists()]
    pictures = [image for image in parsed.all("img") if "src" in image]
    assert pictures and all(image.get("alt") for image in pictures)
    assert not any(name.startswith("on") for _, attributes in parsed.elements for name in attributes)
