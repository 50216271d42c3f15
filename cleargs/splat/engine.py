"""Rendering and its gradients without autograd: what training runs on."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cleargs.errors import InputError
from cleargs.splat.backend import backend_for
from cleargs.splat.camera import Camera
from cleargs.splat.constants import SH_DEGREES
from cleargs.splat.gaussians import Gaussians


class Render(NamedTuple):
    """One rendered view."""

    image: Tensor  # [H, W, 3] sRGB; not clamped above
    alpha: Tensor  # [H, W] 1 - final transmittance
    depth: Tensor | None  # [H, W] accumulated: the sum of weight * camera z, not divided by alpha


def sh_count(gaussians: Gaussians, sh_degree: int | None) -> int:
    """Number of SH coefficients that a degree uses; None means all that are stored.

    Raises:
        InputError: when the degree is negative or above what is stored.
    """
    if sh_degree is None:
        return int(gaussians.sh.shape[1])
    if not 0 <= sh_degree <= gaussians.sh_degree:
        raise InputError(
            f"SH degree {sh_degree} is asked for, the Gaussians store degree {gaussians.sh_degree}",
            hint=f"use a degree from 0 to {gaussians.sh_degree}",
        )
    return next(count for count, degree in SH_DEGREES.items() if degree == sh_degree)


class Engine:
    """Renders float32 Gaussians and differentiates the picture, with buffers kept from call to call.

    Everything returned is a view into these buffers and valid until the next call of the same method.
    Results are bitwise the same for any number of threads, and from run to run on one GPU.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._rasteriser = backend_for(device).rasteriser(torch.device(device))

    @property
    def visible(self) -> Tensor:
        """[N] bool: the Gaussians that reach alpha 1/255 at a pixel's tile in the last view."""
        return self._rasteriser.radii > 0

    def forward(
        self,
        gaussians: Gaussians,
        camera: Camera,
        *,
        sh_degree: int | None = None,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        antialias: bool = False,
        depth: bool = False,
    ) -> Render:
        """Render a view; ``depth`` is None unless asked for. The arguments are those of ``render``.

        The parameters are read in place: do not change them between ``forward`` and ``backward``.

        Raises:
            InputError: when the parameters are not float32 or the SH degree is not stored.
            StageError: when there are more (tile, splat) pairs than 2^31 - 1, or than fit in memory.
        """
        if gaussians.means.dtype != torch.float32:
            raise InputError(
                f"the kernels take float32 parameters, not {gaussians.means.dtype}",
                hint="convert them, or call render(), which sends float64 to the reference",
            )
        image, alpha, depths = self._rasteriser.forward(
            gaussians,
            camera,
            sh_count=sh_count(gaussians, sh_degree),
            background=background,
            antialias=antialias,
            depth=depth,
        )
        return Render(image, alpha, depths)

    def backward(
        self,
        grad_image: Tensor,  # [H, W, 3]
        grad_alpha: Tensor | None = None,  # [H, W]
        grad_depth: Tensor | None = None,  # [H, W]
    ) -> Gaussians:
        """Gradients of the five parameters of the last ``forward``.

        Gaussians that are not visible, and SH coefficients above the degree in use, get exactly 0.
        """
        return self._rasteriser.backward(grad_image, grad_alpha, grad_depth)

    def screen_gradients(self) -> Tensor:
        """dL/d(projected mean) [N, 2] of the last ``backward``, by px; 0 where not visible. Own memory."""
        return self._rasteriser.screen_gradients()
