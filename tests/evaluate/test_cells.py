"""What is read off the cells of a comparison: means, spreads, paired differences, and the tables of them."""

from __future__ import annotations

from cleargs.evaluate.cells import Cell, Cells, ViewSet, spread
from cleargs.evaluate.tables import markdown

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
        evaluation="evaluations/x",
    )


def cells(*gains: float) -> Cells:
    """Samples of very different level, on which the full method gains so much each."""
    found = []
    for number, gain in enumerate(gains):
        level = 20.0 + 5.0 * number
        found.append(cell("all-view", f"s{number}", psnr=level, lpips_alex=0.4, musiq=None))
        found.append(cell("full", f"s{number}", psnr=level + gain, lpips_alex=0.3, musiq=None))
    return Cells(found)


def test_the_spread_of_one_value_is_unknown() -> None:
    assert spread([3.0]).deviation is None
    assert not spread([3.0]).is_none
    # Deviation with n - 1: values 1 and 3 lie 1 from their mean; sqrt(2 / 1).
    assert spread([1.0, 3.0]).deviation == 2.0**0.5


def test_differences_are_paired_within_samples() -> None:
    difference = cells(1.0, 1.25).difference("observed", "mixed", "full", "all-view", "psnr")
    assert difference is not None
    # The samples' levels differ by 5 dB; the gains do not, and only these count.
    assert difference.mean == 1.125
    assert difference.deviation is not None and difference.deviation < 0.2
    assert not difference.is_none


def test_a_difference_below_its_spread_is_none() -> None:
    found = cells(1.0, -1.0, 0.2)
    difference = found.difference("observed", "mixed", "full", "all-view", "psnr")
    assert difference is not None and difference.is_none
    assert "none (+0.07 ± 1.01)" in markdown(found, LABELS, ("all-view",))


def test_a_sample_without_its_baseline_takes_no_part() -> None:
    found = Cells([*cells(1.0).cells, cell("full", "lonely", psnr=99.0)])
    difference = found.difference("observed", "mixed", "full", "all-view", "psnr")
    assert difference is not None and (difference.mean, difference.count) == (1.0, 1)


def test_best_is_lowest_for_lpips_and_highest_elsewhere() -> None:
    found = cells(-1.0)
    assert found.best("observed", "mixed", "psnr") == "all-view"
    assert found.best("observed", "mixed", "lpips_alex") == "full"
    assert found.best("observed", "mixed", "musiq") is None


def test_tables() -> None:
    text = markdown(cells(1.0), LABELS, ("all-view", "drop-blurry"))
    assert "| all-view G0 | 20.00 |" in text
    assert "| ClearGS | **21.00** |" in text
    assert "| ClearGS | LPIPS (AlexNet) | -0.1000 (-25 %) |" in text
    assert "| ClearGS | 2 s + 1 s |" in text
    assert "musiq" not in text, "a metric that was never measured has no table"
    assert "drop-blurry" not in text, "a baseline that was not run has no table"
