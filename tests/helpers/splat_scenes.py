"""Small scenes for the splatting tests, and the comparison of the kernels with a reference in float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.render import render
from cleargs.splat.types import Render

BACKGROUND = (0.1, 0.2, 0.3)


def make_camera(width: int = 64, height: int = 48, focal: float | None = None) -> Camera:
    """A camera away from the origin, rotated by 0.1 rad about y, with the principal point off the centre."""
    focal = 0.9 * width if focal is None else focal
    angle = 0.1
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = 0.2, -0.1, 0.3
    return Camera(width, height, focal, 1.05 * focal, 0.52 * width, 0.47 * height, pose)


def make_gaussians(
    camera: Camera,
    n: int,
    *,
    seed: int = 0,
    opacity: tuple[float, float] = (0.05, 0.95),
    size_px: float = 4.0,
    aspect: float = 2.0,
    sh_count: int = 16,
) -> Gaussians:
    """``n`` random Gaussians in the camera's frustum and slightly outside, with unnormalised quaternions."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(2, 10, n)
    u = rng.uniform(-0.1, 1.1, n) * camera.width
    v = rng.uniform(-0.1, 1.1, n) * camera.height
    local = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1)
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    sigma = (size_px * np.exp(rng.normal(0, 0.4, n)) * z / camera.fx)[:, None]
    opacities = rng.uniform(*opacity, n)
    sh = rng.normal(0, 0.15, (n, sh_count, 3))
    sh[:, 0] = rng.normal(0.3, 1.0, (n, 3))
    arrays = (
        (local - translation) @ rotation,
        np.log(sigma * aspect ** rng.uniform(-1, 1, (n, 3))),
        rng.normal(size=(n, 4)) * rng.uniform(0.3, 3.0, (n, 1)),
        np.log(opacities / (1 - opacities)),
        sh,
    )
    return Gaussians(*(torch.tensor(array, dtype=torch.float32) for array in arrays))


def at(camera: Camera, local: npt.NDArray[np.float64]) -> Tensor:
    """World positions [N, 3] of camera coordinates ``local`` [N, 3]."""
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return torch.tensor((local - translation) @ rotation, dtype=torch.float32)


def make_needles(
    camera: Camera, n: int, *, length_px: float, aspect: float, distance: float = 0.0
) -> Gaussians:
    """``n`` needles at random angles through random pixels, with centres ``distance`` px from these pixels.

    They are parallel to the image plane. Their standard deviation is ``length_px`` along the needle, and
    ``length_px`` / ``aspect`` across it before the dilation.
    """
    gaussians = make_gaussians(camera, n, opacity=(0.1, 0.9))
    rng = np.random.default_rng(n)
    angle, z = rng.uniform(0, 2 * np.pi, n), rng.uniform(2, 10, n)
    focal = np.array([camera.fx, camera.fy])
    along = np.stack([np.cos(angle), np.sin(angle)], 1)  # px
    centre = rng.uniform(0, [camera.width, camera.height], (n, 2)) + distance * along
    plane = (centre - [camera.cx, camera.cy]) / focal * z[:, None]
    gaussians.means[:] = at(camera, np.column_stack([plane, z]))
    axis = np.column_stack([along / focal * z[:, None], np.zeros(n)]) @ camera.world_to_camera[:3, :3]
    world_px = np.linalg.norm(axis, axis=1)  # world units for a px along the needle
    axis /= world_px[:, None]
    # The rotation from the x axis to ``axis``: w = 1 + x · axis, (x, y, z) = x × axis.
    turn = np.column_stack([1 + axis[:, 0], np.zeros(n), -axis[:, 2], axis[:, 1]])
    gaussians.rotations[:] = torch.tensor(turn)
    sizes = length_px * world_px[:, None] / np.array([1.0, aspect, aspect])
    gaussians.log_scales[:] = torch.tensor(np.log(sizes))
    return gaussians


@dataclass
class Comparison:
    """Maximum errors of the kernels, compared with the reference."""

    image: float  # max |error| of image and alpha
    depth: float  # max |error| relative to the largest depth
    gradients: dict[str, float]  # max |error| / max |gradient| of each parameter
    alpha: Tensor  # [H, W], from the reference
    gradient_sizes: dict[str, float]  # max |gradient|
    fragile: float  # share of ignored pixels, where float32 may be on the other side of a cut-off


def leaves(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    """Copies of the parameters that collect gradients."""
    return Gaussians(
        *(tensor.detach().to(dtype).clone().requires_grad_() for tensor in gaussians.tensors().values())
    )


# float32 has a precision of 6e-8. Blending tens of splats and 2^x (a polynomial of relative error 1e-6 on a
# CPU, 2 ulp on a GPU) gave errors up to 1.4e-6 in the image, and up to 3.3e-6 of the largest gradient.
IMAGE_TOLERANCE = 3e-6
GRADIENT_TOLERANCE = 1e-5


def assert_close(
    result: Comparison, image: float = IMAGE_TOLERANCE, gradient: float = GRADIENT_TOLERANCE
) -> None:
    """Assert that the errors are within the tolerances, and that few pixels are ignored."""
    assert result.fragile < 0.05
    assert result.image < image
    assert result.depth < image
    for name, error in result.gradients.items():
        assert error < gradient, name


def compare(
    gaussians: Gaussians,
    camera: Camera,
    *,
    device: torch.device | str = "cpu",
    antialias: bool = False,
    sh_degree: int | None = None,
    margin: float = 2e-5,
) -> Comparison:
    """Render with kernels and reference, and differentiate a random linear functional of all three outputs.

    Pixels are ignored if an alpha is within ``margin`` (relative) of 1/255, or a transmittance of 1e-4: the
    image is discontinuous there, so float32 may differ.
    """
    from benchmarks.speed import reference
    from cleargs.splat.kernels.rasteriser import sh_count

    single, double = leaves(gaussians, torch.float32), leaves(gaussians, torch.float64)
    ours = render(single.to(device), camera, background=BACKGROUND, sh_degree=sh_degree, antialias=antialias)
    ours = Render(*(output.cpu() for output in ours))
    truth = reference.render(
        double, camera, background=BACKGROUND, sh_count=sh_count(double, sh_degree), antialias=antialias
    )
    safe = truth.margin > margin
    generator = torch.Generator().manual_seed(7)
    shape = (camera.height, camera.width)
    weights = [torch.randn(*shape, k, generator=generator, dtype=torch.float64) for k in (3, 1, 1)]
    for outputs in (ours, truth):
        functional = sum(
            (output.double().reshape(*shape, -1) * weight * safe[..., None]).sum()
            for output, weight in zip(outputs[:3], weights, strict=True)
        )
        functional.backward()
    gradients, sizes = {}, {}
    for name in single.tensors():
        mine, exact = getattr(single, name).grad.double(), getattr(double, name).grad
        sizes[name] = exact.abs().max().item()
        gradients[name] = (mine - exact).abs().max().item() / max(sizes[name], 1e-30)
    image_error = ((ours.image - truth.image).abs() * safe[..., None]).max().item()
    alpha_error = ((ours.alpha - truth.alpha).abs() * safe).max().item()
    depth_error = ((ours.depth - truth.depth).abs() * safe).max().item()
    return Comparison(
        image=max(image_error, alpha_error),
        depth=depth_error / max(1.0, truth.depth.max().item()),
        gradients=gradients,
        alpha=truth.alpha.detach(),
        gradient_sizes=sizes,
        fragile=1.0 - safe.double().mean().item(),
    )
