"""Contact sheets."""

from __future__ import annotations

import numpy as np

from cleargs.media.contact_sheet import Tile, contact_sheet


def test_images_lie_in_their_rows_and_columns() -> None:
    red = np.zeros((30, 40, 3), np.float32)
    red[..., 0] = 1.0
    blue = red[..., ::-1]
    sheet = contact_sheet([[Tile(red, "a"), Tile(blue, "b", marked=True)], [Tile(blue, "c")]], tile_width=80)
    assert sheet.dtype == np.uint8
    assert sheet.shape[1] == 2 * 80 + 4
    top, bottom = sheet[: len(sheet) // 2], sheet[len(sheet) // 2 :]
    assert (top[40:80, 5:75] == (255, 0, 0)).all()
    assert (top[40:80, 90:160] == (0, 0, 255)).all()
    assert (bottom[40:80, 5:75] == (0, 0, 255)).all()
    assert not (bottom[40:80, 90:160] > 100).any()


def test_empty_tiles_keep_their_place() -> None:
    image = np.ones((10, 20, 3), np.float32)
    sheet = contact_sheet([[Tile(None, "nothing"), Tile(image, "white")]], tile_width=20)
    assert (sheet[22:32, 24:] == 255).all()
    assert (contact_sheet([[Tile(None, "alone")]]) > 0).any()
