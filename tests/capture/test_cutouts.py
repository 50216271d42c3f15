"""Pictures that are transparent in places: empty space, if each is cut out for itself."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cleargs.capture.cutouts import are_cut_outs, resampled
from cleargs.capture.tables import load_frames
from cleargs.media.image import reduced
from cleargs.scene.views import view_of

from .conftest import HEIGHT, WIDTH, Ingest


def cut(folder: Path, widths: list[int]) -> None:
    """Make the left columns of each picture transparent, with a pixel of half alpha next to them."""
    for width, path in zip(widths, sorted((folder / "images").iterdir()), strict=True):
        alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
        alpha[:, :width] = 0
        alpha[:, width] = 128
        cv2.imwrite(str(path), np.dstack([cv2.imread(str(path)), alpha]))


@pytest.mark.parametrize("alike", [False, True])
def test_cut_outs_keep_their_alpha(posed: Path, ingest: Ingest, alike: bool) -> None:
    cut(posed, [40] * 10 if alike else [40 + 3 * index for index in range(10)])
    done = ingest(posed)
    what = "ignored, like masks" if alike else "empty there"
    assert any(line.startswith("10 of 10 images are transparent") and what in line for line in done.infos)
    assert not any("border" in text or "never move" in text for text in done.warnings)
    frame = load_frames(done.out)[0]
    assert frame.mask is not None
    mask = cv2.imread(str(done.out / frame.mask), cv2.IMREAD_GRAYSCALE)
    assert (mask[:, :40] == 0).all() and (mask[:, 41:] == 255).all()
    view = view_of(frame, done.out, 1.0)
    alpha = None if view.transparency is None else view.transparency()
    if alike:
        assert alpha is None, "the same in all pictures: a border"
    else:
        assert alpha is not None and view.load()[0].shape == (HEIGHT, WIDTH, 3)
        assert [int(alpha[5, column]) for column in (39, 40, 41)] == [0, 128, 255]


def test_pixels_of_a_mask_are_not_empty(posed: Path, ingest: Ingest) -> None:
    cut(posed, [40 + 3 * index for index in range(10)])
    (posed / "masks").mkdir()
    for path in (posed / "images").iterdir():
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:50] = 0
        cv2.imwrite(str(posed / "masks" / path.name), mask)
    out = ingest(posed).out
    view = view_of(load_frames(out)[0], out, 1.0)
    alpha = None if view.transparency is None else view.transparency()
    assert alpha is not None and (alpha[:50] == 255).all() and (alpha[50:, :40] == 0).all()


def test_transparent_pixels_give_no_colour_to_others() -> None:
    rgb, alpha = np.zeros((40, 40, 3), np.uint8), np.zeros((40, 40), np.uint8)
    rgb[:, 13:], alpha[:, 13:] = 200, 255
    rgb[:, :13] = 7
    small, levels = resampled(rgb, alpha, lambda picture: reduced(picture, 20))
    assert levels[3, 5:8].tolist() == [0, 128, 255] or levels[3, 5:8].tolist() == [0, 127, 255]
    assert np.abs(small[:, 6:].astype(int) - 200).max() <= 2


def test_some_transparent_pictures_are_no_cut_outs(posed: Path) -> None:
    paths = sorted((posed / "images").iterdir())
    assert not are_cut_outs(paths)
    cut(posed, [40 + 3 * index for index in range(10)])
    assert are_cut_outs(paths)
    cv2.imwrite(str(paths[4]), cv2.imread(str(paths[4])))
    assert not are_cut_outs(paths)
