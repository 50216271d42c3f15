"""Regions of a frame that the scene of the other frames does not explain."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from cleargs.formation.movement import Boxes, Movement, read_movement, regions, static_pixels, write_movement
from cleargs.splat.camera import Camera
from cleargs.splat.types import Render

HEIGHT, WIDTH, FRAMES = 108, 192, 6
DEPTH, STEP = 4.0, 0.1
"""Distance of the wall that all cameras look at, and between two cameras."""


def picture() -> Tensor:
    """Coloured squares of four pixels, [H, W, 3] sRGB."""
    coarse = np.random.default_rng(0).uniform(0.2, 0.8, (HEIGHT // 4, WIDTH // 4, 3)).astype(np.float32)
    return torch.from_numpy(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST))


def disc(x: float = 60, y: float = 50, radius: float = 20) -> Tensor:
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return torch.from_numpy(np.hypot(columns - x, rows - y) < radius)


def with_disc(where: Tensor) -> Tensor:
    seen = picture()
    seen[where] = torch.tensor([0.9, 0.1, 0.1])
    return seen


def movement(
    apart: float = STEP, tolerance: float = 0.05, likely: dict[int, Boxes] | None = None
) -> Movement:
    cameras = {}
    for k in range(FRAMES):
        pose = np.eye(4)
        pose[0, 3] = -apart * k
        cameras[k] = Camera(WIDTH, HEIGHT, 160.0, 160.0, WIDTH / 2, HEIGHT / 2, pose)
    return Movement(cameras, tolerance, likely=likely)


def look(
    found: Movement, frame_id: int, observed: Tensor, mask: Tensor | None = None, shown: Tensor | None = None
) -> None:
    """Compare a frame with a wall that shows `picture`."""
    image = picture() if shown is None else shown
    alpha = torch.ones(HEIGHT, WIDTH)
    found.check(frame_id, image, Render(image, alpha, DEPTH * alpha), 0, observed, mask)


def looked(targets: dict[int, Tensor], found: Movement | None = None) -> Movement:
    """Look at all frames, twice, since the first look at a frame has no witnesses."""
    found = found or movement()
    for _ in range(2):
        for k in range(FRAMES):
            look(found, k, targets.get(k, picture()))
    return found


def still(found: Movement, frame_id: int, mask: Tensor | None = None) -> Tensor | None:
    return found.static_mask(frame_id, mask, picture())


def test_noise_blur_and_another_exposure_are_not_movement() -> None:
    noise = 2 / 255 * torch.from_numpy(np.random.default_rng(1).standard_normal(picture().shape)).float()
    soft = torch.from_numpy(cv2.GaussianBlur(picture().numpy(), (0, 0), 1.0))
    found = looked({0: picture() + noise, 1: soft, 2: 0.8 * picture()})
    assert found.masks() == {}
    mask = disc()
    assert still(found, 0) is None and still(found, 0, mask) is mask


def test_a_thing_in_one_frame_does_not_count_and_the_rest_does() -> None:
    found = looked({2: with_disc(disc())})
    assert list(found.masks()) == [2]
    counts = still(found, 2)
    assert counts is not None and not counts[disc()].any()
    # Cells have 6 pixels. The region's border is one cell wide.
    assert counts[~disc(radius=20 + 20)].all()
    mask = disc(150)
    both = still(found, 2, mask)
    assert both is not None and torch.equal(both, counts & mask)


def test_a_screen_keeps_the_picture_of_most_frames() -> None:
    """It is seen in all frames, and two of six show another picture on it."""
    shift = 160.0 * STEP / DEPTH  # px between two frames
    places = [80 - shift * k for k in range(FRAMES)]
    boxes = {k: ((int(x) - 20, 30, int(x) + 20, 70),) for k, x in enumerate(places)}
    other = {k: with_disc(disc(places[k])) for k in (1, 4)}
    assert sorted(looked(other, movement(likely=boxes)).masks()) == [1, 4]


def test_less_evidence_suffices_where_a_person_is_seen() -> None:
    faint = {2: picture() + 0.035 * disc(radius=8)[..., None]}
    box = {2: ((50, 40, 70, 60),)}
    assert looked(faint).masks() == {}
    found = looked(faint, movement(likely=box))
    counts = still(found, 2)
    assert counts is not None and not counts[disc(radius=8)].any() and counts[~disc(radius=40)].all()
    elsewhere = looked(faint, movement(likely={2: ((120, 40, 140, 60),), 3: ((50, 40, 70, 60),)}))
    assert elsewhere.masks() == {}
    assert looked({}, movement(likely=box)).masks() == {}


def test_a_person_who_stays_is_a_part_of_the_scene() -> None:
    shift = 160.0 * STEP / DEPTH  # px between two frames
    places = [80 - shift * k for k in range(FRAMES)]
    boxes = {k: ((int(x) - 20, 30, int(x) + 20, 70),) for k, x in enumerate(places)}
    seen = {k: with_disc(disc(x)) for k, x in enumerate(places)}
    assert looked(seen, movement(likely=boxes)).masks() == {}


def test_what_most_frames_show_at_the_same_place_is_not_movement() -> None:
    shift = 160.0 * STEP / DEPTH  # px between two frames
    targets = {k: with_disc(disc(80 - shift * k)) for k in range(FRAMES)}
    assert looked(targets).masks() == {}
    assert sorted(looked({k: targets[k] for k in (0, 5)}).masks()) == [0, 5]


def test_a_place_that_no_other_frame_sees_is_not_movement() -> None:
    # The cameras are 8 m apart, and each sees 4.8 m of the wall.
    assert looked({2: with_disc(disc())}, movement(apart=8.0)).masks() == {}


def test_nothing_moves_with_the_tolerance_0() -> None:
    assert movement().due(3, 0.5) and not movement().due(4, 0.5) and not movement().due(3, 0.0)
    assert not movement(tolerance=0.0).due(3, 0.5)


def test_masked_pixels_play_no_part() -> None:
    found = looked({})
    look(found, 2, with_disc(disc()), ~disc(radius=21))
    assert found.masks() == {}
    look(found, 2, with_disc(disc()), torch.zeros(HEIGHT, WIDTH, dtype=torch.bool))
    assert found.masks() == {}


def test_a_small_spot_is_not_a_region() -> None:
    cells = np.zeros((18, 32), np.bool_)
    cells[4:6, 4:6] = True
    assert not regions(cells).any()
    cells[10:14, 10:14] = True
    found = regions(cells)
    assert found[9:15, 9:15].all() and found.sum() == 36


def test_state_and_table_return_the_same(tmp_path: Path) -> None:
    found = looked({2: with_disc(disc()), 4: with_disc(disc(120))})
    again = movement()
    again.restore(found.state())
    look(found, 2, with_disc(disc(70)))
    look(again, 2, with_disc(disc(70)))
    write_movement(tmp_path / "movement.parquet", found.masks())
    read = read_movement(tmp_path / "movement.parquet")
    assert read.keys() == found.masks().keys() == again.masks().keys() == {2, 4}
    for k in read:
        np.testing.assert_array_equal(read[k], found.masks()[k])
        np.testing.assert_array_equal(again.masks()[k], found.masks()[k])


def test_a_later_training_begins_with_the_masks_and_follows_its_own_looks() -> None:
    first = looked({2: with_disc(disc())})
    later = Movement(dict(enumerate(first._cameras)), 0.05, first.masks())
    look(later, 2, with_disc(disc()))  # without witnesses
    np.testing.assert_array_equal(later.masks()[2], first.masks()[2])
    assert looked({}, later).masks() == {}


@pytest.mark.parametrize("factor", [1, 3])
def test_the_size_of_the_frame_does_not_matter(factor: int) -> None:
    cells = regions(np.pad(np.ones((4, 4), np.bool_), ((5, 9), (8, 20))))
    small, large = static_pixels(cells, 36, 64), static_pixels(cells, 36 * factor, 64 * factor)
    np.testing.assert_array_equal(large[::factor, ::factor], small)
