"""The picture of a comparison shows every variant, however many there are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cleargs.evaluate.cells import Cell, Cells
from cleargs.evaluate.variants import VARIANTS
from cleargs.report.comparison_pictures import plot_comparison


def cell(variant: str, psnr: float) -> Cell:
    return Cell(
        column="mixed",
        sample="room",
        variant=variant,
        views="observed",
        means={"psnr": psnr, "ssim": 0.9, "lpips_alex": 0.1, "lpips_vgg": 0.1},
        images=16,
        seconds=1.0,
        shared_seconds=0.0,
        gaussians=1000,
        steps=100,
        sh_degree=2,
        cpu_seconds=1.0,
        peak_memory_gb=1.0,
        evaluation="evaluation",
    )


def test_every_variant_is_within_the_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib import pyplot

    kept: list[object] = []
    monkeypatch.setattr(pyplot, "close", kept.append)  # the figure is looked at after it was written
    cells = Cells([cell(variant.name, 30.0 + number) for number, variant in enumerate(VARIANTS)])
    plot_comparison(tmp_path / "plot.png", cells, {variant.name: variant.label for variant in VARIANTS})
    monkeypatch.undo()
    (figure,) = kept
    assert isinstance(figure, pyplot.Figure)
    left, right = figure.axes[0].get_xlim()
    looks = set()
    for points in figure.axes[0].containers:
        line = points[0]
        (place,) = np.asarray(line.get_xdata())
        assert left < place < right
        looks.add((line.get_marker(), line.get_color()))
    assert len(looks) == len(VARIANTS) - 1  # each its own; the first is what they are measured against
    legend = figure.legends[0].get_window_extent()
    assert legend.x0 >= 0.0 and legend.x1 <= figure.bbox.width
    pyplot.close(figure)
