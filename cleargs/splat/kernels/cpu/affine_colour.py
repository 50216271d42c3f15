"""Per-frame affine colour and its gradient."""

from __future__ import annotations

from numba import prange

from cleargs.splat.kernels.cpu.jit import Array, Floats, kernel


@kernel
def apply_affine(image: Floats, affine: Floats, output: Floats) -> None:
    """output = affine[:, :3] image + affine[:, 3] for every pixel; images [H, W, 3], affine [3, 4]."""
    height, width, _ = image.shape
    for y in prange(height):
        for x in range(width):
            red, green, blue = image[y, x, 0], image[y, x, 1], image[y, x, 2]
            for channel in range(3):
                row = affine[channel]
                output[y, x, channel] = row[0] * red + row[1] * green + row[2] * blue + row[3]


@kernel
def affine_backward(
    image: Floats, affine: Floats, grad_output: Floats, grad_image: Floats, row_sums: Array
) -> None:
    """grad_image = affine[:, :3]ᵀ grad_output, and each row's share of dL/d(affine) [H, 3, 4] float64."""
    height, width, _ = image.shape
    for y in prange(height):
        row_sums[y] = 0.0
        for x in range(width):
            for source in range(3):
                total = affine[0, source] * grad_output[y, x, 0]
                total += affine[1, source] * grad_output[y, x, 1]
                total += affine[2, source] * grad_output[y, x, 2]
                grad_image[y, x, source] = total
            for channel in range(3):
                g = grad_output[y, x, channel]
                for source in range(3):
                    row_sums[y, channel, source] += g * image[y, x, source]
                row_sums[y, channel, 3] += g
