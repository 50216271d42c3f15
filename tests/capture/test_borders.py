"""Borders around the picture are masked whole; dark and clipped parts of a scene are not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from cleargs.capture.overlay import without_scene
from cleargs.capture.tables import load_frames
from cleargs.types import ImageU8, MaskBool

from .conftest import HEIGHT, WIDTH, Ingest, texture, write_transforms

Picture = tuple[ImageU8, MaskBool]
"""A picture [H, W, 3], and the pixels [H, W] that do not show the scene."""

BAR = 50
GRID_Y, GRID_X = np.mgrid[:HEIGHT, :WIDTH]
RADIUS = np.hypot(GRID_X - WIDTH / 2 + 0.5, GRID_Y - HEIGHT / 2 + 0.5)


def scenes(count: int = 12, light: float = 1.0) -> list[ImageU8]:
    """Pictures of a camera that moves across a textured wall."""
    wall, random = texture(3, 900), np.random.default_rng(0)
    places = [(37 * k % 600, 53 * k % 500) for k in range(count)]
    seen = [wall[y : y + HEIGHT, x : x + WIDTH] * light for y, x in places]
    return [np.clip(view + random.normal(0, 1.0, view.shape), 0, 255).astype(np.uint8) for view in seen]


def barred(picture: ImageU8, level: int = 0, *, sides: bool = True) -> Picture:
    """Put bars of one level at the sides, or above and below."""
    pads = ((0, 0), (BAR, BAR)) if sides else ((BAR, BAR), (0, 0))
    made = np.pad(picture, (*pads, (0, 0)), constant_values=level)
    return made, np.pad(np.zeros(picture.shape[:2], np.bool_), pads, constant_values=True)


def blurred(picture: ImageU8) -> Picture:
    made, bars = barred(picture)
    large = cv2.GaussianBlur(cv2.resize(picture, made.shape[1::-1]), (0, 0), 12)
    return np.where(bars[..., None], large, made), bars


def shaded(picture: ImageU8, light: np.ndarray) -> Picture:
    """Darken a picture by ``light`` [H, W] in [0, 1]. Pixels below a tenth show no scene."""
    return (picture * light[..., None]).astype(np.uint8), light < 0.1


def squeezed(picture: ImageU8) -> Picture:
    """The picture after an undistortion elsewhere, with curved black borders."""
    spread = (1 + 0.12 * (2 * RADIUS / WIDTH) ** 2) / 1.1
    across, down = (GRID_X - WIDTH / 2) * spread, (GRID_Y - HEIGHT / 2) * spread
    return shaded(picture, ((np.abs(across) < WIDTH / 2) & (np.abs(down) < HEIGHT / 2)).astype(float))


def captioned(picture: ImageU8) -> Picture:
    """Letterbox with a caption that changes."""
    made, bars = barred(picture, sides=False)
    text = f"{int(picture.sum()) % 9973}"
    return cv2.putText(
        made, text, (90, BAR + HEIGHT + 30), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255,) * 3, 2
    ), bars


BORDERS: dict[str, Callable[[ImageU8], Picture]] = {
    "pillarbox": barred,
    "white bars": lambda picture: barred(picture, 255),
    "letterbox": lambda picture: barred(picture, 16, sides=False),
    "caption": captioned,
    "blurred bars": blurred,
    "circle": lambda picture: shaded(picture, np.clip((110 - RADIUS) / 1.5, 0, 1)),
    "small circle": lambda picture: shaded(picture, np.clip((80 - RADIUS) / 1.5, 0, 1)),
    "hood": lambda picture: shaded(picture, np.clip((185 - RADIUS) / 20, 0, 1)),
    "undistorted": squeezed,
}


def found(pictures: list[ImageU8], folder: Path, quality: int | None = None) -> MaskBool | None:
    """Return the border that is found in ``pictures``, PNG files or JPEG files of a quality."""
    paths = [folder / (f"{k}.png" if quality is None else f"{k}.jpg") for k in range(len(pictures))]
    for path, picture in zip(paths, pictures, strict=True):
        cv2.imwrite(str(path), picture, [] if quality is None else [cv2.IMWRITE_JPEG_QUALITY, quality])
    unused = without_scene(paths)
    return None if unused is None else unused.border


FAINT = ("blurred bars", "hood")
"""Borders that are not told from the scene at night."""


@pytest.mark.parametrize("quality", [None, 80], ids=["png", "jpeg"])
@pytest.mark.parametrize(
    ("kind", "light"),
    [*((kind, 1.0) for kind in BORDERS), *((kind, 0.3) for kind in BORDERS if kind not in FAINT)],
)
def test_a_border_is_masked_whole(kind: str, quality: int | None, light: float, tmp_path: Path) -> None:
    made = [BORDERS[kind](picture) for picture in scenes(light=light)]
    border = found([picture for picture, _ in made], tmp_path, quality)
    assert border is not None
    none = made[0][1]
    assert border[none].mean() > 0.99
    # The soft edge of a hood, and some pixels next to the others.
    assert border[~none].mean() < (0.06 if kind == "hood" else 0.1)


def orbit(count: int = 16) -> list[tuple[int, int]]:
    """Distances by which a dark part reaches into the pictures, px."""
    return [(5 + 7 * k * 5 % 53, 4 + 7 * k * 3 % 41) for k in range(count)]


def night(picture: ImageU8, reach: tuple[int, int]) -> ImageU8:
    """A lamp lights the middle of a room; the rest is black."""
    off = np.hypot(GRID_X - WIDTH / 2 - reach[0] + 30, 1.2 * (GRID_Y - HEIGHT / 2 - reach[1] + 24))
    return (picture * np.clip((110 - off) / 15, 0, 1)[..., None]).astype(np.uint8)


def table(picture: ImageU8, reach: tuple[int, int]) -> ImageU8:
    """A black table at the lower edge."""
    made = picture.copy()
    made[HEIGHT - 20 - reach[0] :] = 0
    return made


def sky(picture: ImageU8, reach: tuple[int, int]) -> ImageU8:
    """A clipped sky above hills."""
    hills = 40 + reach[1] + 15 * np.sin(GRID_X / 40 + reach[0] / 10)
    return np.where((hills > GRID_Y)[..., None], 255, picture).astype(np.uint8)


@pytest.mark.parametrize("quality", [None, 80], ids=["png", "jpeg"])
@pytest.mark.parametrize("kind", [night, table, sky, lambda picture, reach: picture])
def test_dark_and_clipped_parts_of_a_scene_are_no_border(
    kind: Callable[[ImageU8, tuple[int, int]], ImageU8], quality: int | None, tmp_path: Path
) -> None:
    pictures = [kind(p, reach) for p, reach in zip(scenes(16), orbit(), strict=True)]
    border = found(pictures, tmp_path, quality)
    assert border is None or not border.any()


def test_bars_of_a_night_room(tmp_path: Path) -> None:
    """The room is dark next to the bars in many pictures; only the bars are masked."""
    made = [barred(night(p, reach)) for p, reach in zip(scenes(16), orbit(), strict=True)]
    border = found([picture for picture, _ in made], tmp_path)
    assert border is None or not border[:, BAR + 4 : -BAR - 4].any()


def test_a_still_camera_has_no_border(tmp_path: Path) -> None:
    picture = scenes(1)[0]
    assert found([barred(picture)[0]] * 8, tmp_path) is None


def test_ingest_masks_bars_and_places_all_frames(
    frames: list[tuple[np.ndarray, ImageU8]], tmp_path: Path, ingest: Ingest
) -> None:
    folder = tmp_path / "barred"
    (folder / "images").mkdir(parents=True)
    for index, (_, image) in enumerate(frames):
        cv2.imwrite(str(folder / "images" / f"{index:03d}.png"), barred(image)[0])
    write_transforms(folder, [pose for pose, _ in frames], w=WIDTH + 2 * BAR, cx=WIDTH / 2 + BAR)
    done = ingest(folder)
    assert any("border around the picture" in text for text in done.warnings)
    assert not any("never move" in text for text in done.warnings)
    mask = load_frames(done.out)[0].mask
    assert mask is not None
    kept = cv2.imread(str(done.out / mask), cv2.IMREAD_GRAYSCALE) > 0
    assert not kept[:, :BAR].any() and not kept[:, -BAR:].any() and kept[:, BAR + 4 : -BAR - 4].all()
