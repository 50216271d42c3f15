"""The page of a batch: scenes in several states, two of them with results."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_pages import CAUSE, batch_page
from pages import Page, assert_offline


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return batch_page(tmp_path_factory.mktemp("pages"))


def test_the_page_holds_all_that_it_shows_and_leads_to(page: Path) -> None:
    assert_offline(page)
    assert sum(file.stat().st_size for file in page.parent.rglob("*")) < 200_000
    parsed = Page(page.read_text())
    leads = [link["href"] for link in parsed.all("a") if str(link["href"]).startswith("../")]
    assert leads == ["../logs/cellar.log", "../scenes/attic/report/index.html"]
    assert [image["alt"] for image in parsed.all("img")] == ["barn: the first frame", "attic: the scene"]


def test_the_worst_scene_comes_first(page: Path) -> None:
    text = " ".join(Page(page.read_text()).text.split())
    assert "1 of 3 scenes is done" in text and "1 failed, 1 waiting, 1 done" in text
    cards = text[text.index("All 3") :]
    assert cards.index("cellar") < cards.index("barn") < cards.index("attic")
    assert CAUSE in cards and len(Page(page.read_text()).all("script")) == 1
    assert "0 of 5 stages" in cards and "5 of 5 stages" in cards
    assert "6 of 7 frames placed" in text and "24.6 dB PSNR on pixels that no training saw" in text
