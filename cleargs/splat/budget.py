"""Steps and Gaussians of a training: how many where the settings leave it open, and what these start as.

Neither is one number for all captures. Steps follow the frames, since each is to be seen often enough;
Gaussians follow the pixels, since they have that much to say. ``quality`` scales both. docs/speed.md has
what each step up costs and brings.
"""

from __future__ import annotations

from typing import Literal

Quality = Literal["draft", "standard", "high"]

STEPS_A_FRAME = 50
MIN_STEPS, MAX_STEPS = 3200, 7200
STEPS_FACTOR: dict[Quality, float] = {"draft": 0.25, "standard": 1.0, "high": 4.0}

PIXELS_A_GAUSSIAN = 160
MIN_BUDGET = 40_000
BUDGET_FACTOR: dict[Quality, float] = {"draft": 0.5, "standard": 1.0, "high": 2.0}

INIT_SCALE = 0.5
"""Starting scale of a Gaussian per distance to its neighbours (docs/experiments/training.md)."""
INIT_OPACITY = 0.5
"""Starting opacity of a Gaussian (3DGS-MCMC)."""


def steps_from_frames(frames: int, quality: Quality = "standard") -> int:
    """Steps of the first scene of a capture with so many active frames."""
    return round(STEPS_FACTOR[quality] * min(max(STEPS_A_FRAME * frames, MIN_STEPS), MAX_STEPS))


def budget_from_pixels(pixels: int, max_budget: int, quality: Quality = "standard") -> int:
    """Most Gaussians of a capture whose active frames hold ``pixels`` pixels in all.

    One Gaussian (59 numbers at SH degree 3) for 160 pixels (480 numbers, most seen by several frames),
    40,000 at least, since fewer cost a small capture a dB, and ``max_budget`` at most: all times the
    quality's factor.
    """
    standard = min(max(pixels // PIXELS_A_GAUSSIAN, MIN_BUDGET), max_budget)
    return max(1, int(BUDGET_FACTOR[quality] * standard))
