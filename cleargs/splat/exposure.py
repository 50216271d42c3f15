"""Per-frame exposure compensation: an affine map on sRGB, with gradients summed in a fixed order."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from cleargs.splat.kernels.cuda import support


def apply_affine(image: Tensor, affine: Tensor) -> Tensor:
    """The image [H, W, 3] with every pixel mapped by ``affine`` [3, 4] (matrix and offset), float32."""
    if support.on_gpu(image.device):
        from cleargs.splat.kernels.cuda import colour as gpu_colour

        return gpu_colour.apply_affine(image, affine)
    from cleargs.splat.kernels.cpu import colour, launch

    output = torch.empty(image.shape)
    with launch.exclusive():
        colour.apply_affine(
            image.detach().contiguous().numpy(), affine.detach().float().contiguous().numpy(), output.numpy()
        )
    return output


def affine_backward(image: Tensor, affine: Tensor, grad_output: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of ``apply_affine``: with respect to the image [H, W, 3] and to the map [3, 4] (float64)."""
    if support.on_gpu(image.device):
        from cleargs.splat.kernels.cuda import colour as gpu_colour

        return gpu_colour.affine_backward(image, affine, grad_output)
    from cleargs.splat.kernels.cpu import colour, launch

    grad_image = torch.empty(image.shape)
    row_sums = np.empty((image.shape[0], 3, 4), np.float64)
    with launch.exclusive():
        colour.affine_backward(
            image.detach().contiguous().numpy(),
            affine.detach().float().contiguous().numpy(),
            grad_output.detach().contiguous().numpy(),
            grad_image.numpy(),
            row_sums,
        )
    sums = [math.fsum(column) for column in row_sums.reshape(len(row_sums), 12).T]
    return grad_image, torch.tensor(sums, dtype=torch.float64).reshape(3, 4)
