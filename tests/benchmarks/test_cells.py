"""Means, spreads and paired differences of the cells of a comparison, and their tables."""

from __future__ import annotations

import json
import math

import pytest

from benchmarks.comparison.cells import Cell, Cells, ViewSet, spread, student_t
from benchmarks.comparison.findings import Comparison
from benchmarks.comparison.roles import FOR_SHARE, KINDS, Roles
from benchmarks.comparison.tables import Results, difference_text, markdown
from cleargs.evaluate.eval_report import Region

LABELS = {"all-view": "all-view G0", "full": "ClearGS"}


def cell(variant: str, sample: str, views: ViewSet = "observed", **means: float | None) -> Cell:
    return Cell(
        column="mixed",
        sample=sample,
        variant=variant,
        views=views,
        means=means,
        images=4,
        seconds=2.0,
        shared_seconds=1.0,
        gaussians=10,
        steps=100,
        sh_degree=1,
        cpu_seconds=4.0,
        peak_memory_gb=0.5,
        evaluation="evaluations/x",
    )


def roles(strong: int, reactivated: int) -> Roles:
    frames = dict.fromkeys(map(str, KINDS), 0) | {"strong": strong, FOR_SHARE: reactivated}
    return Roles(column="mixed", sample="s", variant="full", frames=frames)


def cells(*gains: float) -> Cells:
    """Samples with very different PSNR, on which the whole method gains ``gains`` dB."""
    found = []
    for number, gain in enumerate(gains):
        level = 20.0 + 5.0 * number
        found.append(cell("all-view", f"s{number}", psnr=level, lpips_alex=0.4, musiq=None))
        found.append(cell("full", f"s{number}", psnr=level + gain, lpips_alex=0.3, musiq=None))
    return Cells(found)


def test_spread_of_one_value_is_unknown() -> None:
    assert spread([3.0]).deviation is None
    assert not spread([3.0]).includes_zero
    # Sample deviation (n - 1): values 1 and 3 are 1 from their mean, so sqrt(2 / 1).
    assert spread([1.0, 3.0]).deviation == 2.0**0.5


def test_intervals_match_values_by_hand() -> None:
    # Quantiles from a printed table of Student's t, 97.5 %: 12.706, 2.776 and 2.262 for 1, 4 and 9 degrees of
    # freedom.
    assert student_t(1) == pytest.approx(12.706, abs=5e-4)
    assert student_t(4) == pytest.approx(2.776, abs=5e-4)
    assert student_t(9) == pytest.approx(2.262, abs=5e-4)
    # 1 .. 5: mean 3, deviation sqrt(10 / 4), half width 2.776 sqrt(2.5) / sqrt(5) = 2.776 sqrt(0.5) = 1.963.
    found = spread([1.0, 2.0, 3.0, 4.0, 5.0])
    assert found.half_width == pytest.approx(1.963, abs=5e-4)
    assert found.excludes_zero and not found.includes_zero
    # The same around 1.5: the interval is 1.5 +- 1.963 and includes 0.
    found = spread([-0.5, 0.5, 1.5, 2.5, 3.5])
    assert found.includes_zero and not found.excludes_zero
    # The mean is 1.4 deviations, but the interval of two values is much wider.
    assert spread([1.0, 3.0]).includes_zero
    # One value has no interval.
    assert spread([3.0]).half_width is None and not spread([3.0]).excludes_zero


def test_differences_are_paired_within_samples() -> None:
    difference = cells(1.0, 1.25, 1.125).difference("observed", "mixed", "full", "all-view", "psnr")
    assert difference is not None
    # Only the gains count; the PSNR of samples differs by 5 dB.
    assert difference.mean == 1.125
    assert difference.deviation is not None and difference.deviation < 0.2
    assert difference.excludes_zero


def test_insignificant_difference_is_shown_as_none() -> None:
    found = cells(1.0, -1.0, 0.2)
    difference = found.difference("observed", "mixed", "full", "all-view", "psnr")
    assert difference is not None and difference.includes_zero
    # Mean 0.0667, deviation 1.0066, times 4.303 / sqrt(3).
    assert "none (+0.07 ± 2.50)" in markdown(Results(found, (), ()), LABELS, ("all-view",))


def test_sample_without_baseline_is_left_out() -> None:
    found = Cells([*cells(1.0).cells, cell("full", "lonely", psnr=99.0)])
    difference = found.difference("observed", "mixed", "full", "all-view", "psnr")
    assert difference is not None and (difference.mean, difference.count) == (1.0, 1)


def test_best_is_lowest_for_lpips_and_highest_for_others() -> None:
    found = cells(-1.0)
    assert found.best("observed", "mixed", "psnr") == "all-view"
    assert found.best("observed", "mixed", "lpips_alex") == "full"
    assert found.best("observed", "mixed", "musiq") is None


def test_tables() -> None:
    text = markdown(Results(cells(1.0), (roles(4, 2), roles(3, 3)), ()), LABELS, ("all-view", "drop-blurry"))
    assert "| all-view G0 | 20.00 |" in text
    assert "| ClearGS | **21.00** |" in text
    assert "| ClearGS | LPIPS (AlexNet) | -0.1000 (-25 %) |" in text
    assert "| ClearGS | 100 | 10 | 1 | 4 | 0.50 | 2 + 1 |" in text
    assert "| mixed | ClearGS | 7 | 0 | 0 | 0 | 5 | 0 |" in text, "frames of both samples"
    assert "against the truth\n\n|" not in text, "there are no choices without RIVR"
    assert "musiq" not in text, "a metric without values has no table"
    assert "drop-blurry" not in text, "a baseline that was not run has no table"


def test_mean_over_fewer_samples_is_not_the_best() -> None:
    """Else a variant that failed on the hard capture would win."""
    found = Cells(
        [
            cell("all-view", "easy", psnr=30.0),
            cell("full", "easy", psnr=31.0),
            cell("lost", "easy", psnr=30.5),
            cell("all-view", "hard", psnr=20.0),
            cell("full", "hard", psnr=21.0),
        ]
    )
    assert found.best("observed", "mixed", "psnr") == "full"
    lost = found.difference("observed", "mixed", "lost", "all-view", "psnr")
    base = found.spread("observed", "mixed", "all-view", "psnr")
    assert difference_text(lost, base, "psnr") == "+0.50 (n = 1)"


def test_infinite_psnr_survives_json() -> None:
    text = cell("full", "s", psnr=math.inf, ssim=1.0).model_dump_json()
    json.loads(text, parse_constant=pytest.fail)  # Infinity is not valid JSON
    assert Cell.model_validate_json(text).means["psnr"] == math.inf
    assert Region.model_validate_json(Region(share=0.1, psnr=math.inf).model_dump_json()).psnr == math.inf
    document = Comparison(cells=[cell("full", "s", psnr=math.inf)]).document()
    assert document["cells"][0]["means"] == {"psnr": "Infinity"}
