"""Weights of pixels that the scene does not explain."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from cleargs.formation.observed import pixel_weights

HEIGHT, WIDTH = 108, 192
TOLERANCE = 0.05


def picture() -> Tensor:
    """Coloured squares of four pixels, [H, W, 3] sRGB."""
    coarse = np.random.default_rng(0).uniform(0.2, 0.8, (HEIGHT // 4, WIDTH // 4, 3)).astype(np.float32)
    return torch.from_numpy(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST))


def disc() -> Tensor:
    """Mask [H, W] of an object in front of the scene: a disc with a radius of a tenth of the width."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return torch.from_numpy(np.hypot(x - 60, y - 50) < 0.1 * WIDTH)


def counts(render: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    return pixel_weights(render, target, mask, TOLERANCE)


def test_a_frame_with_nothing_unexplained_counts_whole_to_the_bit() -> None:
    """Noise, missing detail and another exposure are not mistaken for movement."""
    seen = picture()
    noise = 2 / 255 * torch.from_numpy(np.random.default_rng(1).standard_normal(seen.shape)).float()
    soft = torch.from_numpy(cv2.GaussianBlur(seen.numpy(), (0, 0), 1.0))
    for render in (seen, seen + noise, soft, 0.8 * seen):
        assert torch.equal(counts(render, seen), torch.ones(HEIGHT, WIDTH))


def test_what_stands_in_front_of_the_scene_counts_next_to_nothing_and_the_rest_whole() -> None:
    seen, inside = picture(), disc()
    seen[inside] = torch.tensor([0.9, 0.1, 0.1])
    got = counts(picture(), seen)
    # A difference of 0.4 is 8 tolerances: 1 / 64 in the middle, more at the rim in cells half covered.
    assert got[inside].mean() < 0.1
    # The cells have 8 pixels: beyond two of them nothing is seen of it.
    near = cv2.dilate(inside.numpy().astype(np.uint8), np.ones((33, 33), np.uint8)) > 0
    assert torch.equal(got[~torch.from_numpy(near)], torch.ones(int((~near).sum())))


def test_masked_pixels_play_no_part() -> None:
    seen, mask = picture(), ~disc()
    painted = torch.where(mask[..., None], seen, torch.ones(3))
    assert torch.equal(counts(seen, painted, mask), torch.ones(HEIGHT, WIDTH))
    nothing = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    assert torch.isfinite(counts(seen, painted, nothing)).all()


def test_the_size_of_the_frame_does_not_matter() -> None:
    def at(scale: int) -> Tensor:
        seen = picture()
        seen[disc()] = torch.tensor([0.9, 0.1, 0.1])
        images = (np.repeat(np.repeat(image.numpy(), scale, 0), scale, 1) for image in (picture(), seen))
        return counts(*(torch.from_numpy(image) for image in images))

    # Cells end at whole pixels, so their borders lie up to a pixel apart: seen at the rim of the disc.
    assert (at(3)[1::3, 1::3] - at(1)).abs().mean() < 0.01


def test_the_counts_do_not_depend_on_threads() -> None:
    seen = picture()
    seen[disc()] = torch.tensor([0.9, 0.1, 0.1])
    before, got = torch.get_num_threads(), []
    for threads in (1, 4):
        torch.set_num_threads(threads)
        got.append(counts(picture(), seen))
    torch.set_num_threads(before)
    assert torch.equal(*got)
