"""A term of the loss that compares texture: local moments of shallow VGG16 features on a crop of the image.

L1 and SSIM average fine texture away if its exact place is uncertain. The maps of the first three layers of
VGG16 (Simonyan and Zisserman 2015, trained on ImageNet) respond to edges and texture of up to 10 px. LPIPS
with VGG16 uses these layers too, so a scene that is trained with this term is measured with AlexNet's LPIPS
(docs/measuring.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from cleargs.errors import InputError
from cleargs.random_streams import Stream
from cleargs.safe_io import FAULTS, faults_as
from cleargs.torch_threads import one_thread

WEIGHTS = Path(__file__).parents[1] / "models/weights/vgg16-layers.safetensors"
"""Kernels and biases of the three convolutions in float16, 0.2 MB."""

_FAULTS: tuple[type[Exception], ...] = (*FAULTS, SafetensorError)

SIDE = 0.2
"""Side of a crop relative to the root of the image's area. So the cost is the same share of any step."""
LEAST_SIDE = 32
"""Least side of a crop, px, where the image is as large."""
WINDOW = 8
"""Side of the windows in which texture may move, px."""

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and deviation of the colours of ImageNet, sRGB in [0, 1], per channel."""


def crop_of(seed: Sequence[int], step: int, height: int, width: int) -> tuple[slice, slice]:
    """Return rows and columns of the square crop of a step, at a random place of the image."""
    side = 8 * int(min(height, width, max(LEAST_SIDE, SIDE * (height * width) ** 0.5 + 4)) / 8)
    rng = np.random.default_rng([*seed, Stream.TEXTURE, step])
    top, left = int(rng.integers(height - side + 1)), int(rng.integers(width - side + 1))
    return slice(top, top + side), slice(left, left + side)


class TextureLoss:
    """The term and its gradient, on one device.

    The convolutions run on one thread of the CPU: with several, torch may add in another order. Raises
    InputError if the weights, which are a part of the installation, cannot be read.
    """

    def __init__(self, device: torch.device | str) -> None:
        with faults_as(InputError, f"{WEIGHTS} cannot be read", hint="install ClearGS again", faults=_FAULTS):
            weights = {name: tensor.float().to(device) for name, tensor in load_file(WEIGHTS).items()}
        self._layers = [(weights[f"{i}.weight"], weights[f"{i}.bias"]) for i in range(3)]
        self._mean, self._deviation = (
            torch.tensor(colour, device=device).view(1, 3, 1, 1) for colour in (MEAN, DEVIATION)
        )

    def distance(self, image: Tensor, target: Tensor) -> Tensor:
        """Return the distance of two images [h, w, 3] sRGB in [0, 1] whose sides are multiples of 8 px.

        It compares mean and standard deviation of each map in windows of 8 x 8 px, four pixels apart, as
        Wasserstein distortion does (Qiu et al. 2024): texture at another place of a window costs little. The
        result is the sum over two layers of the mean differences, relative to the mean of the target's maps.
        """
        with torch.no_grad():
            targets = self._maps(target)
        total = torch.zeros((), device=image.device)
        for halvings, (x, y) in enumerate(zip(self._maps(image), targets, strict=True)):
            window, scale = WINDOW >> halvings, y.mean() + 1e-3
            for ours, theirs in zip(_moments(x, window, scale), _moments(y, window, scale), strict=True):
                total = total + (ours - theirs).abs().mean() / scale
        return total

    def gradient(self, image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:  # [h, w, 3]
        """Return the gradient of `distance` by ``image``.

        Pixels outside ``mask`` [h, w] (True: the pixel counts) have no influence on it, and get no gradient.
        """
        if mask is not None:
            target = torch.where(mask[..., None], target, image)
        image = image.detach().clone().requires_grad_()
        with _fixed_order(), torch.enable_grad():
            (gradient,) = torch.autograd.grad(self.distance(image, target), image)
        return gradient if mask is None else gradient * mask[..., None]

    def _maps(self, image: Tensor) -> list[Tensor]:
        """Return the maps of the second and the third layer, [1, 64, h, w] and [1, 128, h / 2, w / 2]."""
        x = (image.permute(2, 0, 1)[None] - self._mean) / self._deviation
        maps = []
        for index, (kernel, bias) in enumerate(self._layers):
            if index == 2:
                x = functional.max_pool2d(x, 2)  # no overlap: on a GPU, its gradient has no sums either
            x = functional.relu(functional.conv2d(x, kernel, bias, padding=1))
            if index > 0:
                maps.append(x)
        return maps


def _moments(maps: Tensor, window: int, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation of maps in each window of ``window`` x ``window``."""
    mean, square = (functional.avg_pool2d(values, window, window // 2) for values in (maps, maps * maps))
    variance = (square - mean * mean).clamp(min=0.0)
    return mean, (variance + 1e-4 * scale * scale).sqrt()  # the root of 0 has no derivative


@contextmanager
def _fixed_order() -> Iterator[None]:
    """Let torch add in the same order in every run, for any number of threads."""
    exact = torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False)
    with one_thread(), exact:
        yield
