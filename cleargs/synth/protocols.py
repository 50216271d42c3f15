"""What is wrong with each frame of a synthetic capture, by protocol name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cleargs.errors import InputError

REFERENCE_WIDTH = 640
"""Blur lengths and radii are stated in pixels at this image width."""


@dataclass(frozen=True)
class Degradation:
    """The faults of one frame; lengths in pixels at `REFERENCE_WIDTH`."""

    blur: float = 0.0
    """Mean length of the motion path in the image."""
    defocus: float = 0.0
    """Mean radius of the blur disc."""
    exposure: float = 0.0
    """Exposure error in stops."""
    noise: float = 1.0 / 255
    """Standard deviation of the sensor noise at mid grey, in sRGB units."""


def _sharp(frames: int, rng: np.random.Generator) -> list[Degradation]:
    return [Degradation() for _ in range(frames)]


def _blurred(mean: float) -> Callable[[int, np.random.Generator], list[Degradation]]:
    """Motion blur of every frame, gamma-distributed (shape 4) about ``mean`` pixels, as in GS2E."""

    def draw(frames: int, rng: np.random.Generator) -> list[Degradation]:
        return [Degradation(blur=float(length)) for length in mean * rng.gamma(4, 1 / 4, frames)]

    return draw


def _mixed(frames: int, rng: np.random.Generator) -> list[Degradation]:
    """What phones give: half the frames sharp; of the rest 60 % blurred, 20 % defocused, 20 % misexposed."""
    bad = rng.permutation(np.arange(frames) % 2 == 1) if frames > 32 else np.arange(frames) % 2 == 1
    result = []
    for is_bad in bad:
        fault = rng.uniform()
        if not is_bad:
            result.append(Degradation(blur=float(rng.uniform(0, 0.8))))
        elif fault < 0.6:
            result.append(Degradation(blur=float(rng.uniform(7, 22)), noise=2 / 255))
        elif fault < 0.8:
            result.append(Degradation(defocus=float(rng.uniform(3, 6))))
        else:
            stops = float(rng.choice([-1, 1]) * rng.uniform(1.3, 2.2))
            result.append(Degradation(exposure=stops, noise=3 / 255))
    return result


PROTOCOLS: dict[str, Callable[[int, np.random.Generator], list[Degradation]]] = {
    "sharp": _sharp,
    "mixed": _mixed,
    "gs2e-slight": _blurred(6),
    "gs2e-medium": _blurred(12),
    "gs2e-severe": _blurred(20),
}


def degradations(protocol: str, frames: int, seed: int) -> list[Degradation]:
    """The faults of each frame. Raises InputError for a name that is not in `PROTOCOLS`."""
    if protocol not in PROTOCOLS:
        raise InputError(f"no protocol is called {protocol!r}", hint=f"choose one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[protocol](frames, np.random.default_rng([seed, 13]))
