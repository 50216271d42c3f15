"""CPU implementation of `cleargs.splat.backend.Backend`: torch tensors in and out, Numba kernels inside.

`Backend` documents the functions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cleargs.splat import densification
from cleargs.splat.camera import Camera, Readout
from cleargs.splat.constants import ADAM_BETAS, ADAM_EPSILON
from cleargs.splat.formation import clip_to_saturation
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu import blur_sums as blur_kernels
from cleargs.splat.kernels.cpu import elementwise, frame_search, frame_warp, loss, noise
from cleargs.splat.kernels.cpu.jit import LAUNCHING
from cleargs.splat.kernels.cpu.pipeline import CpuRasteriser
from cleargs.splat.kernels.warp_layout import (
    CHANNELS,
    CURVE_STEPS,
    CURVES,
    MOTION_COLUMNS,
    DisplacementFields,
)
from cleargs.splat.types import Moments, Rates
from cleargs.types import AnyArray, ArrayF32

ADAM_BLOCK = 4096
"""Approximate number of elements per work item."""


def rasteriser(device: torch.device) -> CpuRasteriser:
    return CpuRasteriser()


def loss_sums(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None,
    *,
    l1_weight: float,
    ssim_weight: float,
    saturated: float,
    gradient: Tensor,
) -> Tensor:
    image, too_bright = clip_to_saturation(image, target, saturated)
    shape = (image.shape[0], loss.padded_length(image.shape[1]))
    padded, padded_target, counted = (np.empty(shape, np.float32) for _ in range(3))
    # No kernel reads the padding of the maps, so it need not be set.
    maps = np.empty((3, *shape), np.float32)
    row_sums = np.empty((shape[0], 3), np.float64)
    window = loss.ssim_window()
    with LAUNCHING:
        loss.pad_images(*_compared(image, target, mask), padded, padded_target, counted)
        loss.measure(padded, padded_target, counted, window, maps, row_sums)
        l1, similarity, count = (math.fsum(column) for column in row_sums.T)
        if count == 0 or l1_weight == ssim_weight == 0.0:
            gradient.zero_()
        else:
            l1_scale, ssim_scale = np.float32(l1_weight / count), np.float32(ssim_weight / count)
            loss.differentiate(
                padded, padded_target, counted, window, maps, l1_scale, ssim_scale, gradient.numpy()
            )
    gradient.masked_fill_(too_bright, 0.0)
    squared, _ = squared_errors(image, target, mask)
    return torch.tensor([l1, similarity, squared, count], dtype=torch.float64)


def squared_errors(image: Tensor, target: Tensor, mask: Tensor | None) -> tuple[float, float]:
    row_sums = np.empty((image.shape[0], 2), np.float64)
    with LAUNCHING:
        loss.squared_errors(*_compared(image, target, mask), row_sums)
    return math.fsum(row_sums[:, 0]), math.fsum(row_sums[:, 1])


def _read(tensor: Tensor) -> ArrayF32:
    array: ArrayF32 = tensor.detach().contiguous().numpy()
    return array


def _compared(
    image: Tensor, target: Tensor, mask: Tensor | None
) -> tuple[ArrayF32, ArrayF32, AnyArray | None]:
    return _read(image), _read(target), None if mask is None else _read(mask)


def step_gaussians(
    gaussians: Gaussians,
    gradients: Gaussians,
    moments: Moments,
    rates: Rates,
    *,
    step: int,
    opacity: float,
    scale: float,
) -> None:
    _regularise(gaussians, gradients, opacity=opacity, scale=scale)
    slopes = gradients.tensors()
    for name, parameter in gaussians.tensors().items():
        if parameter.numel():
            by_column = np.full(parameter.numel() // len(parameter), getattr(rates, name))
            if name == "sh":
                by_column[3:] = rates.sh_rest
            _adam(parameter, slopes[name], moments.first[name], moments.second[name], step, by_column)


def _adam(
    parameter: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    step: int,
    rates: npt.NDArray[np.float64],  # a learning rate per column
) -> None:
    columns = len(rates)
    beta1, beta2 = ADAM_BETAS
    corrected = (rates / (1.0 - beta1**step)).astype(np.float32)
    value, slope, m, v = (tensor.detach().view(-1).numpy() for tensor in (parameter, gradient, first, second))
    with LAUNCHING:
        elementwise.adam(
            *(value, slope, m, v, np.tile(corrected, max(1, ADAM_BLOCK // columns))),
            *map(np.float32, (beta1, beta2, ADAM_EPSILON, math.sqrt(1.0 - beta2**step))),
        )


def _regularise(gaussians: Gaussians, gradients: Gaussians, *, opacity: float, scale: float) -> None:
    """Add the gradients of opacity * mean(opacities) + scale * mean(scales)."""
    if opacity > 0.0:
        opacities = densification.sigmoid(gaussians.logit_opacities.numpy())
        weight = np.float32(opacity / gaussians.num)
        gradients.logit_opacities.numpy()[:] += weight * opacities * (1 - opacities)
    if scale > 0.0:
        scales = np.exp(gaussians.log_scales.numpy())
        gradients.log_scales.numpy()[:] += np.float32(scale / scales.size) * scales


def refine(
    gaussians: Gaussians,
    moments: Moments,
    *,
    errors: Tensor,
    rate: float,
    budget: int,
    min_opacity: float,
    seed: Sequence[int],
) -> tuple[Gaussians, Moments]:
    arrays = {name: tensor.numpy() for name, tensor in gaussians.tensors().items()}
    running = [
        {name: tensor.numpy() for name, tensor in group.items()} for group in (moments.first, moments.second)
    ]
    arrays, running = densification.refine(
        arrays,
        running,
        errors=errors.double().numpy(),
        rate=rate,
        budget=budget,
        min_opacity=min_opacity,
        rng=np.random.default_rng([*seed]),
    )
    grown, first, second = (
        {name: torch.from_numpy(array) for name, array in group.items()} for group in (arrays, *running)
    )
    return Gaussians(**grown), Moments(first, second)


def add_position_noise(
    gaussians: Gaussians, *, amount: float, min_opacity: float, seed: Sequence[int]
) -> None:
    key = np.random.SeedSequence([*seed]).generate_state(1, np.uint64)[0]
    means, log_scales, rotations = gaussians.means, gaussians.log_scales, gaussians.rotations
    with LAUNCHING:
        noise.add_noise(
            *(means.numpy(), log_scales.numpy(), rotations.numpy(), gaussians.logit_opacities.numpy()),
            *(amount, min_opacity, densification.NOISE_CUT, key),
        )


def apply_affine(image: Tensor, affine: Tensor) -> Tensor:
    output = torch.empty(image.shape)
    with LAUNCHING:
        elementwise.apply_affine(_read(image), _read(affine.float()), output.numpy())
    return output


def affine_backward(image: Tensor, affine: Tensor, grad_output: Tensor) -> tuple[Tensor, Tensor]:
    grad_image = torch.empty(image.shape)
    row_sums = np.empty((image.shape[0], 3, 4), np.float64)
    with LAUNCHING:
        elementwise.affine_backward(
            _read(image), _read(affine.float()), _read(grad_output), grad_image.numpy(), row_sums
        )
    sums = [math.fsum(column) for column in row_sums.reshape(len(row_sums), 12).T]
    return grad_image, torch.tensor(sums, dtype=torch.float64).reshape(3, 4)


def displacements(depth: Tensor, alpha: Tensor, motion: Tensor, *, margin: int) -> DisplacementFields:
    height, width = (side - 2 * margin for side in depth.shape)
    offset, sweep = torch.empty(2, height, width), torch.empty(2, height, width)
    radius, reach = torch.empty(height, width), np.empty(height)
    curve = torch.empty(4, height, width) if motion[CURVES:].any() else None
    with LAUNCHING:
        frame_warp.displacements(
            *(_read(depth), _read(alpha), margin, motion.numpy(), offset.numpy(), sweep.numpy()),
            *(radius.numpy(), None if curve is None else curve.numpy(), reach),
        )
    return DisplacementFields(offset, sweep, radius, float(reach.max()), curve)


def expose(image: Tensor, fields: DisplacementFields, samples: Tensor, *, margin: int) -> Tensor:
    arrays = _arrays(fields)
    light = torch.empty(*fields.radius.shape, CHANNELS)
    with LAUNCHING:
        frame_warp.expose(_read(image), margin, *arrays, _read(samples), light.numpy())
    return light


def expose_backward(light: Tensor, fields: DisplacementFields, samples: Tensor, *, margin: int) -> Tensor:
    height, width = fields.radius.shape
    image = torch.empty(height + 2 * margin, width + 2 * margin, CHANNELS)
    rows, columns, _ = image.shape
    reach = rows if fields.reach is None else min(math.ceil(fields.reach) + 3, rows)
    count = -(-height // frame_warp.BAND)
    bands = np.empty((count, frame_warp.BAND + 2 * reach, columns, CHANNELS), np.float32)
    with LAUNCHING:
        frame_warp.spread(_read(light), margin, reach, *_arrays(fields), _read(samples), bands, rows)
        frame_warp.gather(bands, margin, reach, image.numpy())
    return image


def _arrays(fields: DisplacementFields) -> tuple[ArrayF32, ArrayF32, ArrayF32, ArrayF32 | None]:
    """Return offset, sweep, radius and curve as the kernels read them."""
    curve = None if fields.curve is None else _read(fields.curve)
    return _read(fields.offset), _read(fields.sweep), _read(fields.radius), curve


def through_curve(image: Tensor, curve: Tensor, channels: int) -> tuple[Tensor, Tensor]:
    out, slope = torch.empty(*image.shape[:2], channels), torch.empty(*image.shape[:2], 3)
    with LAUNCHING:
        frame_warp.apply_curve(_read(image), _read(curve), out.numpy(), slope.numpy())
    return out, slope


def times_slope(light: Tensor, slope: Tensor, channels: int) -> Tensor:
    out = torch.empty(*slope.shape[:2], channels)
    with LAUNCHING:
        frame_warp.multiply(_read(light), _read(slope), out.numpy())
    return out


def read_displacements(
    depth: ArrayF32, alpha: ArrayF32, lens: ArrayF32, twists: ArrayF32, down: ArrayF32, across: ArrayF32
) -> ArrayF32:
    """Return the displacements [2, H, W], px, by a rolling shutter: see `frame_warp.read_displacements`."""
    out = np.empty((2, *depth.shape), np.float32)
    with LAUNCHING:
        frame_warp.read_displacements(depth, alpha, lens, twists, down, across, out)
    return out


def flows(
    basis: ArrayF32, twists: npt.NDArray[np.float64], asked: npt.NDArray[np.bool_]
) -> ArrayF32:  # [T, 2, H, W]
    """Return the image motion, px, of each twist [T, 6]. Rows that are not ``asked`` [H] for are 0."""
    out = np.empty((len(twists), *basis.shape[1:]), np.float32)
    with LAUNCHING:
        frame_search.flows(basis, twists.astype(np.float32), asked, out)
    return out


def residual(
    image: ArrayF32,  # [H, W]
    observed: ArrayF32,  # [H, W]
    weight: ArrayF32,  # [H, W]
    fields: tuple[ArrayF32, ArrayF32, ArrayF32, ArrayF32 | None],
    samples: ArrayF32,  # [K, 3]
    limit: float,
) -> float:
    """Return the sum over all rows of `frame_search.residuals`.

    ``fields`` are offset, sweep, radius and curve in px.
    """
    rows = np.empty(len(image))
    with LAUNCHING:
        frame_search.residuals(image, observed, weight, *fields, samples, limit, rows)
    return math.fsum(rows)


def normal_equations(
    image: ArrayF32,  # [H, W]
    smooth: ArrayF32,  # [H, W]
    observed: ArrayF32,  # [H, W]
    weight: ArrayF32,  # [H, W]
    basis: ArrayF32,  # [6, 2, H, W]
    down: ArrayF32,  # [H]
    offset: ArrayF32,  # [2, H, W]
    sweep: ArrayF32,  # [2, H, W]
    curve: ArrayF32 | None,  # [4, H, W]
    times: ArrayF32,  # [K]
    outlier: float,
    active: npt.NDArray[np.int64],  # [A]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the matrix [A, A] and right side [A] of the equations of `frame_search.normal_equations`."""
    height, count = len(observed), len(active)
    matrices, sides = np.empty((height, count, count)), np.empty((height, count))
    with LAUNCHING:
        frame_search.normal_equations(
            *(image, smooth, observed, weight, basis, down, offset, sweep, curve),
            *(times, outlier, active, matrices, sides),
        )
    return matrices.sum(axis=0), sides.sum(axis=0)


def blur_sums(
    render: ArrayF32,  # [H, W]
    observed: ArrayF32,  # [H, W]
    weight: ArrayF32,  # [H, W]
    stride: int,
    tile: int,
) -> npt.NDArray[np.float64]:  # [2, 8, 8]
    rows = max(0, -(-(len(render) - 2) // stride))
    sums = np.empty((rows, 2, blur_kernels.TERMS, blur_kernels.TERMS))
    with LAUNCHING:
        blur_kernels.blur_sums(render, observed, weight, stride, tile, sums)
    lower: npt.NDArray[np.float64] = sums.sum(axis=0)
    return np.asarray(lower + np.tril(lower, -1).swapaxes(1, 2))


SIZE = 16
"""Width and height of the tiny images on which `warm_up` runs the kernels."""


def warm_up() -> None:
    """Run every kernel with the types of a training, in the order of its steps.

    The backward pass runs with and without alpha and depth, because Numba compiles each case separately.
    """
    scene = Gaussians(  # one grey Gaussian in front of the camera
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        log_scales=torch.full((1, 3), -2.0),
        rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        logit_opacities=torch.zeros(1),
        sh=torch.zeros(1, 16, 3),
    )
    camera = Camera(SIZE, SIZE, float(SIZE), float(SIZE), SIZE / 2, SIZE / 2, np.eye(4))
    pipeline = CpuRasteriser()
    image = torch.zeros(SIZE, SIZE, 3)
    plane = torch.zeros(SIZE, SIZE)
    mask = torch.ones(SIZE, SIZE, dtype=torch.bool)
    affine = torch.eye(3, 4)
    row = torch.zeros(1, 3)
    for depth in (False, True):
        pipeline.forward(scene, camera, depth=depth)
    pipeline.backward(image)
    pipeline.backward(image, plane)
    pipeline.backward(image, plane, plane)
    pipeline.forward(scene, replace(camera, readout=Readout(np.zeros((3, 6)), 1.0, 0.0)))
    for counted in (None, mask):
        weights = {"l1_weight": 0.8, "ssim_weight": -0.2, "saturated": 1.0}
        loss_sums(image, image, counted, **weights, gradient=image.clone())
    _adam(row, row.clone(), row.clone(), row.clone(), 1, np.zeros(3))
    add_position_noise(scene, amount=0.0, min_opacity=0.005, seed=(0,))
    apply_affine(image, affine)
    affine_backward(image, affine, image)
    _warm_up_formation()


def _warm_up_formation() -> None:
    """Run the kernels of image formation and of the search for a frame's motion."""
    plane, colours = torch.ones(SIZE, SIZE), torch.zeros(SIZE, SIZE, CHANNELS)
    _, slope = through_curve(colours, torch.zeros(CURVE_STEPS + 1), CHANNELS)
    times_slope(colours, slope, CHANNELS)
    pixels = plane.numpy()
    read_displacements(
        pixels, pixels, np.ones(5, np.float32), np.zeros((3, 6), np.float32), pixels[0], pixels[0]
    )
    for last in (CURVES, MOTION_COLUMNS):  # straight and curved paths
        still = torch.zeros(MOTION_COLUMNS)
        still[:last] = 1.0
        fields = displacements(plane, plane, still, margin=0)
        light = expose(colours, fields, torch.zeros(1, 3), margin=0)
        expose_backward(light, fields, torch.zeros(1, 3), margin=0)
        offset, sweep, radius, curve = _arrays(fields)
        residual(pixels, pixels, pixels, (offset, sweep, radius, curve), np.zeros((1, 3), np.float32), 1.0)
        normal_equations(
            *(pixels, pixels, pixels, pixels),
            *(np.zeros((6, 2, SIZE, SIZE), np.float32), np.zeros(SIZE, np.float32), offset, sweep),
            *(curve, np.zeros(1, np.float32), 1.0, np.arange(6)),
        )
    flows(np.zeros((6, 2, SIZE, SIZE), np.float32), np.zeros((1, 6)), np.ones(SIZE, np.bool_))
    blur_sums(pixels, pixels, pixels, 2, 4)
