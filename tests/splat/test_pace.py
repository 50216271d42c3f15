"""The pace of this machine: measurement and cache."""

from __future__ import annotations

from pathlib import Path

import pytest

from cleargs.splat import pace
from cleargs.splat.kernels.cpu.jit import compiled_mark
from cleargs.splat.pace import REFERENCE_MS, cached_pace, machine_pace

Results = list[float | None]


@pytest.fixture
def results(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Results:
    """Results of the next measurements; the cache has compiled kernels only."""
    waiting: Results = []
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    compiled_mark("cpu").touch()
    monkeypatch.setattr(pace, "_measure_in_subprocess", lambda: waiting.pop(0))
    return waiting


def nobody(text: str) -> None: ...


def test_nothing_is_measured_without_a_message(results: Results) -> None:
    assert machine_pace() == 1.0 and cached_pace() is None


def test_pace_is_measured_once(results: Results) -> None:
    said: list[str] = []
    results.append(1.5 * REFERENCE_MS)
    assert machine_pace(said.append) == 1.5 and len(said) == 1
    assert machine_pace(said.append) == machine_pace() == cached_pace() == 1.5
    assert len(said) == 1, "there is no result for a second measurement"


@pytest.mark.parametrize("change", ["processor", "host", "probe"])
def test_another_machine_is_measured_again(
    results: Results, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    results += [REFERENCE_MS, 2.0 * REFERENCE_MS]
    machine_pace(nobody)
    with monkeypatch.context() as other:
        if change == "processor":
            other.setattr(pace, "processor_name", lambda: "another")
        elif change == "host":
            other.setattr(pace.platform, "node", lambda: "another")
        else:
            other.setattr(pace, "PROBE", pace.PROBE + 1)
        assert machine_pace() == 1.0
        assert machine_pace(nobody) == 2.0
    assert cached_pace() == 1.0, "the cache keeps both"


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{}",
        *(f'{{"milliseconds": {text}}}' for text in ('"x"', "0", "-3.0", "NaN", "Infinity", "null")),
    ],
)
def test_a_damaged_cache_file_is_ignored(results: Results, content: str) -> None:
    results += [REFERENCE_MS, 3.0 * REFERENCE_MS]
    machine_pace(nobody)
    pace._cache_file().write_text(content)
    assert cached_pace() is None and machine_pace() == 1.0
    assert machine_pace(nobody) == cached_pace() == 3.0


def test_a_failed_measurement_gives_the_reference_pace(results: Results) -> None:
    results += [None, 2.0 * REFERENCE_MS]
    assert machine_pace(nobody) == 1.0
    assert machine_pace(nobody) == 2.0, "measured again"


def test_a_failed_measurement_returns_none(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("cleargs.no_such_module", "cleargs.splat"):
        monkeypatch.setattr(pace, "module_command", lambda _, module=module: ["python", "-m", module])
        assert pace._measure_in_subprocess() is None
    monkeypatch.setattr(pace, "module_command", lambda _: ["/no/such/program"])
    assert pace._measure_in_subprocess() is None
    monkeypatch.setattr(pace, "module_command", lambda _: ["echo", "hello"])
    assert pace._measure_in_subprocess() is None


def test_the_subprocess_measures() -> None:
    milliseconds = pace._measure_in_subprocess()
    assert milliseconds is not None and milliseconds > 0.0
