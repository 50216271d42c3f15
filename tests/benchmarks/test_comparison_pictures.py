"""The plot of a comparison shows all variants; images are found by their exact names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.comparison.cells import Cell, Cells
from benchmarks.comparison.pictures import find_image, plot_comparison
from benchmarks.comparison.variants import VARIANTS
from cleargs.media.image import write_rgb


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


def test_plot_shows_every_variant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib import pyplot

    kept: list[object] = []
    monkeypatch.setattr(pyplot, "close", kept.append)  # keeps the figure open for the checks
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
    assert len(looks) == len(VARIANTS) - 1  # all differ; the first one is the baseline
    legend = figure.legends[0].get_window_extent()
    assert legend.x0 >= 0.0 and legend.x1 <= figure.bbox.width
    pyplot.close(figure)


def test_dollars_in_names_are_escaped(tmp_path: Path) -> None:
    found = [cell(name, 30.0) for name in ("all-view", "full")]
    cells = Cells([one.model_copy(update={"column": "b$1_x_$2"}) for one in found])
    plot_comparison(tmp_path / "plot.png", cells, {"all-view": "$a_b_c$", "full": "$^$"})
    assert (tmp_path / "plot.png").is_file()


def test_image_is_found_by_its_exact_name(tmp_path: Path) -> None:
    for name, level in (("b.png", 51), ("b.2.png", 255)):
        write_rgb(tmp_path / name, np.full((4, 4, 3), level, np.uint8))
    (tmp_path / "b.AAE").write_text("metadata of a phone")
    found = find_image(tmp_path, "b")
    assert found is not None and np.allclose(found, 0.2)
    assert find_image(tmp_path, "b.1") is None and find_image(tmp_path / "nowhere", "b") is None
