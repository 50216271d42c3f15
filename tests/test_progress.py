"""What a progress bar says of the speed, and of the time that is left."""

from __future__ import annotations

import pytest

from cleargs import progress
from cleargs.progress import Pace, Rate


def test_the_rate_is_that_of_the_last_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training that slows down from ten steps a second to one: the mean would say 2.5 at its end."""
    now, done = 1000.0, 0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    rate = Rate()
    assert rate.a_second(0) is None
    assert rate.a_second(0) is None  # no time has passed, and nothing is divided by it
    for seconds, speed in ((20, 10), (100, 1)):
        for _ in range(seconds):
            now, done = now + 1.0, done + speed
            shown = rate.a_second(done)
        assert shown == pytest.approx(speed)


def test_a_rate_changes_within_twice_its_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now, done = 0.0, 0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    rate, shown = Rate(), []
    for speed in (4, 2):
        for _ in range(40):
            now, done = now + 1.0, done + speed
            shown.append(rate.a_second(done))
    settled = int(2 * Rate.SECONDS)
    assert shown[1:40] == [4.0] * 39
    assert shown[40 + settled :] == [2.0] * (40 - settled)


def test_no_less_than_nothing_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares of work are sums, which end at 1 but for rounding: the bar said "-0 s left"."""
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    pace = Pace(10)
    pace.seconds_left(1, 0.1)
    now = 3600.0
    assert pace.seconds_left(10, 1.0 + 1e-15) == 0.0
