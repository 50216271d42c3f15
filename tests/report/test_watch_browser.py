"""The page of a running stage in a real browser: it updates itself, and opens the report at the end."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.chromium import CHROMIUM, NO_CHROMIUM, TIMEOUT_MS
from report_run import camera, wall
from watched import reported, serving, working

from cleargs.media.image import write_rgb
from cleargs.pipeline import live
from cleargs.progress import PREVIEW
from cleargs.splat.render import Viewer

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM)]


def until(page: Any, condition: str) -> None:
    """Wait for a condition, from outside, since the policy of the page forbids `eval`."""
    for _ in range(TIMEOUT_MS // 50):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    raise AssertionError(condition)


def test_the_page_follows_the_run(tmp_path: Path, browser: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "WRITE_INTERVAL_S", 0.0)
    made = reported(tmp_path)
    picture = Viewer(wall(1)).view(camera(1))
    complaints: list[str] = []
    with serving(made) as port:
        page = browser.new_page()
        page.set_default_timeout(TIMEOUT_MS)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        with working(made, "g0") as (reporter, checkpoints), reporter.task("<b>G0</b>", total=200) as task:
            page.goto(f"http://127.0.0.1:{port}/")
            until(page, "document.title.startsWith('g0 ')")
            assert page.is_hidden("#preview")
            task.update(done=50, note="20.5 dB, 1000 Gaussians")
            write_rgb(checkpoints / PREVIEW, picture)
            until(page, "document.querySelector('#picture').naturalWidth === 96")
            assert page.inner_text("#label") == "<b>G0</b>"  # no markup
            # After two seconds the time follows.
            assert page.inner_text("#figures").startswith("50 of 200 · 20.5 dB, 1000 Gaussians")
            assert page.evaluate("document.querySelector('#progress').value") == 0.25
            assert page.inner_text("li[data-state='running']").split() == ["g0", "running"]
            first = page.get_attribute("#picture", "src")
            write_rgb(checkpoints / PREVIEW, np.flipud(picture).copy())
            until(page, f"document.querySelector('#picture').getAttribute('src') !== '{first}'")
        page.wait_for_url("**/report/")
        assert page.inner_text("h1") and not complaints
        page.close()
