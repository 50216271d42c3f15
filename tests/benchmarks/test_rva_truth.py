"""Correlation of cues with the known degradations of a synthetic capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.commands import invoke
from benchmarks.rva.truth import Faults, check
from cleargs.cli.main import invoke as cleargs


def correlations(B: list[float], faults: Faults, **cues: list[float]) -> tuple[float | None, ...]:
    columns = {"b_motion_blur": B, "b_defocus": B, "b_exposure_failure": B} | cues
    found = check(
        1.0 - np.array(B),
        np.array(B),
        {name: np.array(values) for name, values in columns.items()},
        np.array(B) < 0.5,
        faults,
    )
    return found.B_blur, found.motion, found.defocus, found.exposure


def test_blur_is_compared_without_other_degradations() -> None:
    """A defocused and a badly exposed frame have a high B but no motion."""
    faults = Faults(
        blur_px=np.array([0.0, 5.0, 9.0, 0.0, 0.0]),
        defocus_px=np.array([0.0, 0.0, 0.0, 4.0, 0.0]),
        exposure_ev=np.array([0.0, 0.0, 0.0, 0.0, -2.0]),
    )
    B_blur, motion, defocus, exposure = correlations(
        [0.0, 0.3, 0.4, 0.9, 0.9],
        faults,
        b_motion_blur=[0.0, 0.3, 0.6, 0.0, 0.0],
        b_defocus=[0.0, 0.0, 0.0, 0.8, 0.0],
        b_exposure_failure=[0.0, 0.0, 0.0, 0.0, 0.7],
    )
    assert (B_blur, motion, defocus, exposure) == pytest.approx((1.0, 1.0, 1.0, 1.0))


def test_small_degradations_count_as_zero() -> None:
    """Sub-pixel blur and drift of automatic exposure do not affect the ranks."""
    faults = Faults(
        blur_px=np.array([0.9, 0.1, 0.5, 8.0]),
        defocus_px=np.zeros(4),
        exposure_ev=np.array([0.2, -0.2, 0.1, 0.0]),
    )
    B_blur, _, defocus, exposure = correlations([0.0, 0.0, 0.0, 0.6], faults)
    assert B_blur == pytest.approx(1.0)
    assert defocus is None
    assert exposure is None


def test_check_reads_the_truth_of_the_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Runs the commands: a synthetic capture, its run up to RVA, the table."""
    capture, run = tmp_path / "capture", tmp_path / "run"
    synth = ["synth", str(capture), "--protocol", "gs2e-severe", "--frames", "6", "--size", "160x96"]
    assert cleargs(synth) == 0
    assert cleargs(["run", str(capture), "-o", str(run), "--until", "rva", "--threads", "1", "-q"]) == 0
    capsys.readouterr()
    assert invoke(["rva", "check", str(run)]) == 0
    head, row = capsys.readouterr().out.splitlines()
    assert "B ~ blur" in head
    assert row.split()[:2] == [str(run), "6"]
    (capture / "truth" / "frames.parquet").unlink()
    assert invoke(["rva", "check", str(run)]) == 2
    assert "has no truth/frames.parquet" in capsys.readouterr().err
