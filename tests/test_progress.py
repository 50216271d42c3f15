"""Speed and remaining time of tasks, and the reporter of the library."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from threading import Event

import pytest

from cleargs import api, progress
from cleargs.errors import InputError
from cleargs.progress import BothTasks, CountedTask, LineReporter, Rate, log_reporter


def test_the_rate_is_that_of_the_last_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training slows down from 10 steps per second to 1. Its mean would be 2.5 at the end."""
    now, done = 1000.0, 0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    rate = Rate()
    assert rate.per_second(0) is None
    assert rate.per_second(0) is None  # no time has passed, and nothing is divided by it
    for seconds, speed in ((20, 10), (100, 1)):
        for _ in range(seconds):
            now, done = now + 1.0, done + speed
            shown = rate.per_second(done)
        assert shown == pytest.approx(speed)


def test_a_rate_changes_within_twice_its_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now, done = 0.0, 0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    rate, shown = Rate(), []
    for speed in (4, 2):
        for _ in range(40):
            now, done = now + 1.0, done + speed
            shown.append(rate.per_second(done))
    settled = int(2 * Rate.SECONDS)
    assert shown[1:40] == [4.0] * 39
    assert shown[40 + settled :] == [2.0] * (40 - settled)


def test_the_remaining_time_is_never_negative(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares of work are sums, which may end slightly above 1. The bar then showed "-0 s left"."""
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    shown: list[float | None] = []
    task = CountedTask(10, lambda done, note, left: shown.append(left))
    task.update(done=1, share=0.1)
    now = 3600.0
    task.update(done=10, share=1.0 + 1e-15)
    assert shown == [None, 0.0]


def seconds_left(monkeypatch: pytest.MonkeyPatch, steps: list[tuple[float, int]]) -> list[float | None]:
    """Return the estimates of a task of 1,000 steps; ``steps`` are times and steps done by then."""
    clock, shown = [0.0], list[float | None]()
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    task = CountedTask(1000, lambda done, note, left: shown.append(left))
    for clock[0], done in steps:
        task.update(done=done)
    return shown


def test_the_remaining_time_follows_the_load(monkeypatch: pytest.MonkeyPatch) -> None:
    """After other programs ended, "2.6 it/s, 806 s left" was printed for 430 steps that took 165 s."""
    slow = [(float(t), t // 2) for t in range(2, 602, 2)]  # 300 steps at half a step per second
    fast = [(600.0 + t, 300 + 3 * t) for t in range(1, 202)]
    left = seconds_left(monkeypatch, slow + fast)
    assert left[len(slow) - 1] == pytest.approx(1400, rel=0.01)
    assert left[-1] == pytest.approx(97 / 3, rel=0.1)


def test_steps_that_are_reported_together_have_no_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the pairs of images came at once: "370/738, 0 s left", and 40 s went by."""
    burst = [(48.0 + k / 1e4, k) for k in range(1, 501)]
    assert set(seconds_left(monkeypatch, burst)) == {None}
    later = seconds_left(monkeypatch, [*burst, (96.0, 501)])[-1]
    assert later == pytest.approx(48, rel=0.01)


def test_screen_and_log_have_one_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once, the log took the steps and the screen the share of the work: 75 s and 863 s left."""
    clock = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    shown: dict[str, float | None] = {}
    tasks = [
        CountedTask(100, lambda d, n, left, x=name: shown.update({x: left})) for name in ("screen", "log")
    ]
    both = BothTasks(*tasks)
    for clock[0], done, share in ((900.0, 10, 0.02), (910.0, 20, 0.04)):
        both.update(done=done, share=share)
    assert shown["screen"] == shown["log"] == pytest.approx(480.0)


def test_a_task_without_steps_says_that_it_works(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LINE_EVERY", 0.02)
    lines: list[str] = []
    seen = Event()

    def say(line: str) -> None:
        lines.append(line)
        if line.startswith("compiling, for "):
            seen.set()

    reporter = LineReporter(lines.append, lines.append, say)
    with reporter.task("all scenes", 3), reporter.task("compiling"):
        assert seen.wait(20)
    assert not [line for line in lines if line.startswith("all scenes, for")], "the innermost task speaks"


def test_a_line_without_a_step_keeps_the_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LINE_EVERY", 0.02)
    monkeypatch.setattr(CountedTask, "LEAST", 0.0)
    lines: list[str] = []
    seen = Event()

    def say(line: str) -> None:
        lines.append(line)
        if len(lines) == 3:
            seen.set()

    with LineReporter(say, say, say).task("cues", 1000) as task:
        task.advance()
        task.update(done=2, share=0.001 + 1e-9)  # so that the rest takes long
        lines.clear()
        assert seen.wait(20)
    assert all(re.fullmatch(r"cues: 2/1000, \d+ s left", line) for line in lines[:3]), lines


def test_remarks_of_the_library_are_logged(
    caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    reporter = log_reporter()
    caplog.set_level(logging.DEBUG, "cleargs")
    reporter.info("rva: starts")
    reporter.warn("100 % of %s")
    with reporter.task("rva", 3) as task:
        task.advance(3)
    found = [(record.name, record.levelname, record.getMessage()) for record in caplog.records]
    assert found[:2] == [("cleargs", "INFO", "rva: starts"), ("cleargs", "WARNING", "100 % of %s")]
    assert found[2][1:] == ("DEBUG", "rva: done in 0.0 s")
    caplog.clear()
    logging.getLogger("cleargs").disabled = True
    try:
        reporter.warn("nobody hears this")
    finally:
        logging.getLogger("cleargs").disabled = False
    assert not caplog.records and capsys.readouterr() == ("", "")


def test_a_run_of_the_library_logs(
    caplog: pytest.LogCaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "photos").mkdir()
    caplog.set_level(logging.INFO, "cleargs")

    def resolve(*arguments: object, reporter: progress.Reporter, **options: object) -> None:
        reporter.info("as in run.toml")
        raise InputError("stop", hint="here")

    monkeypatch.setattr(api, "resolve_run", resolve)
    with pytest.raises(InputError):
        api.run(tmp_path / "photos", tmp_path / "run")
    assert caplog.messages == ["as in run.toml"]
    lines: list[str] = []
    with pytest.raises(InputError):
        api.run(tmp_path / "photos", tmp_path / "run", progress=lines.append)
    assert lines == ["as in run.toml"] and caplog.messages == lines, "the function replaces the logger"
