"""Agreement of RIVR's choices with the truth, computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.comparison.choices import ChoiceRow, agreement, apply_exposure
from cleargs.synth.phone import develop


def row(chosen: str, render: float, restored: float, observed: float) -> ChoiceRow:
    psnr = {"render": render, "restored": restored, "observed": observed}
    # Here a better PSNR means a worse LPIPS, so that the test can distinguish the two.
    lpips = {name: value / 100 for name, value in psnr.items()}
    return ChoiceRow(round=1, frame_id=0, chosen=chosen, psnr=psnr, lpips=lpips)


def test_agreement_by_hand() -> None:
    rows = [
        row("restored", 20.0, 25.0, 22.0),  # best by PSNR, worst by LPIPS
        row("render", 20.0, 26.0, 22.0),  # 6 dB below the best, best by LPIPS
        row("restored", 30.0, 31.0, 34.0),  # the frame image was better by 3 dB
    ]
    found = agreement(rows)
    assert (found.repaired, found.kept) == (3, 0)
    assert found.by_psnr == pytest.approx(1 / 3)
    assert found.by_lpips == pytest.approx(1 / 3)
    assert found.by_chance == pytest.approx(1 / 3)
    assert found.lost_psnr == pytest.approx((0 + 6 + 3) / 3)


def test_frame_kept_as_filmed_counts_separately() -> None:
    kept = row("observed", 20.0, 26.0, 22.0)
    repaired = row("restored", 20.0, 25.0, 22.0)
    found = agreement([kept, repaired])
    assert (found.repaired, found.kept) == (1, 1)
    assert found == agreement([repaired]).model_copy(update={"kept": 1})
    alone = agreement([kept])
    assert alone.kept == 1 and alone.by_psnr is alone.by_lpips is alone.by_chance is alone.lost_psnr is None


def test_no_agreement_by_lpips_without_lpips() -> None:
    plain = row("render", 20.0, 21.0, 22.0).model_copy(update={"lpips": {}})
    assert agreement([plain]).by_lpips is None


def test_truth_gets_the_exposure_of_its_frame() -> None:
    light = np.linspace(0.0, 1.0, 64, dtype=np.float32).reshape(8, 8, 1).repeat(3, 2)
    sharp = develop(light).astype(np.float32) / 255
    for stops in (-1.5, 0.0, 1.5):
        # The simulator's image at these stops. The tolerance covers two roundings to 8 bits; brightening
        # multiplies one of them by 2^1.5 and the slope of sRGB.
        off = develop(light, stops=stops).astype(np.float32) / 255
        assert np.abs(apply_exposure(sharp, stops) - off).max() < 0.012
