"""Faults that a restoration expert may have, planted in its images: what the gate must find.

python tests/rivr/planted.py RUN...     of each fault, the share that the gate refuses on finished runs
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np

from cleargs.media.exr import from_layer, read_exr
from cleargs.rivr.candidates import gaussian_blur
from cleargs.rivr.gates import GateConfig, rejection_reason
from cleargs.types import ImageF32

Fault: TypeAlias = Callable[[ImageF32, np.random.Generator], ImageF32]

SIDE = 64
"""Side of the block that a local fault changes, px."""


def shifted(pixels: int) -> Fault:
    """Out of place along one axis."""
    return lambda image, rng: np.roll(image, pixels * int(rng.choice([-1, 1])), axis=int(rng.integers(2)))


def tinted(share: float) -> Fault:
    """One channel brighter, one darker by ``share``."""
    return lambda image, rng: _clip(image * rng.permutation([1.0 + share, 1.0, 1.0 - share]))


def brightened(share: float) -> Fault:
    """All channels brighter or darker by ``share``."""
    return lambda image, rng: _clip(image * (1.0 + share * rng.choice([-1.0, 1.0])))


def in_block(fault: Fault) -> Fault:
    """``fault`` in one block, anywhere."""

    def apply(image: ImageF32, rng: np.random.Generator) -> ImageF32:
        y, x = (int(rng.integers(length - SIDE + 1)) for length in image.shape[:2])
        block = slice(y, y + SIDE), slice(x, x + SIDE)
        result = image.copy()
        result[block] = fault(image, rng)[block]
        return result

    return apply


def invented(share: float) -> Fault:
    """A quarter of the image blended with another part of it, turned and in other colours."""

    def apply(image: ImageF32, rng: np.random.Generator) -> ImageF32:
        height, width = (length // 2 for length in image.shape[:2])
        result = image.copy()
        result[:height, :width] *= 1.0 - share
        result[:height, :width] += share * image[-height:, -width:][::-1, ::-1, ::-1]
        return result

    return apply


def sharpened(amount: float) -> Fault:
    """An unsharp mask."""
    return lambda image, _: _clip(image + amount * (image - gaussian_blur(image, 1.5)))


def grainy(sigma: float) -> Fault:
    """White noise."""
    return lambda image, rng: _clip(image + rng.normal(0.0, sigma, image.shape))


FAULTS: Mapping[str, Fault] = {
    **{f"shift {pixels} px": shifted(pixels) for pixels in (1, 2, 4)},
    **{f"block shifted {pixels} px": in_block(shifted(pixels)) for pixels in (1, 2, 4)},
    **{f"tint {share:.0%}": tinted(share) for share in (0.08, 0.16)},
    **{f"block tinted {share:.0%}": in_block(tinted(share)) for share in (0.08, 0.16)},
    **{f"block brightened {share:.0%}": in_block(brightened(share)) for share in (0.08, 0.16)},
    **{f"invented quarter {share:.0%}": invented(share) for share in (0.3, 0.6)},
    **{f"unsharp mask {amount}x": sharpened(amount) for amount in (1, 2, 4)},
    **{f"grain {sigma}": grainy(sigma) for sigma in (0.03, 0.06)},
    "channels swapped": lambda image, _: np.ascontiguousarray(image[..., ::-1]),
    "half the contrast": lambda image, _: np.float32(0.5) + np.float32(0.5) * image,
}


def _clip(image: np.ndarray) -> ImageF32:
    return np.clip(image, 0.0, 1.0).astype(np.float32)


def main(runs: list[Path]) -> None:
    """Print how many repairs of the last round the gate refuses, as they are and with each fault."""
    exrs = [path for run in runs for path in sorted(sorted(run.glob("rivr/round_*"))[-1].glob("*.exr"))]
    refused = dict.fromkeys(["none", *FAULTS], 0)
    for k, path in enumerate(exrs):
        layers = {name: from_layer(layer) for name, layer in read_exr(path).layers.items()}
        cases = {"none": layers["restored"]}
        cases |= {name: fault(layers["restored"], np.random.default_rng(k)) for name, fault in FAULTS.items()}
        for name, image in cases.items():
            refused[name] += (
                rejection_reason(image, layers["observed"], layers["render"], GateConfig()) is not None
            )
    for name, count in refused.items():
        print(f"{name:24} {count / len(exrs):6.1%}  of {len(exrs)}")


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
