"""Base of the rasterisers of both back ends: interface, reusable buffers, memory limit."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from cleargs.errors import InputError, StageError
from cleargs.splat.camera import Camera
from cleargs.splat.constants import SH_DEGREES, VIEW_CLAMP
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cuda.support import available_memory
from cleargs.splat.kernels.splat_layout import MAX_PAIRS, TILE
from cleargs.splat.rolling import own_poses
from cleargs.splat.scene import Scene
from cleargs.splat.types import Render

UNCHECKED_BYTES = 2**28
"""Bytes that are allocated without a check of the free memory, which takes about a millisecond."""


def sh_count(gaussians: Gaussians, sh_degree: int | None) -> int:
    """Return the number of SH coefficients per channel that a degree uses (None: the stored degree).

    Raises InputError if the degree is negative or above the stored one.
    """
    if sh_degree is None:
        return int(gaussians.sh.shape[1])
    if not 0 <= sh_degree <= gaussians.sh_degree:
        raise InputError(
            f"SH degree {sh_degree} is not available: the Gaussians store degree {gaussians.sh_degree}",
            hint=f"use a degree from 0 to {gaussians.sh_degree}",
        )
    return next(count for count, degree in SH_DEGREES.items() if degree == sh_degree)


def tiles_of(camera: Camera) -> int:
    """Return the number of tiles of an image."""
    return -(-camera.width // TILE) * -(-camera.height // TILE)


def view_numbers(camera: Camera) -> list[float]:
    """Return a camera as the 23 numbers that the kernels read.

    They are the rows of the world-to-camera rotation, its translation, the camera's centre in the world, fx,
    fy, cx and cy in px, and gsplat's bounds of x/z and y/z in the Jacobian (left, right, top, bottom).
    """
    pose = camera.world_to_camera
    beyond_x = VIEW_CLAMP * 0.5 * camera.width / camera.fx
    beyond_y = VIEW_CLAMP * 0.5 * camera.height / camera.fy
    numbers = [
        *pose[:3, :3].ravel().tolist(),
        *pose[:3, 3].tolist(),
        *camera.centre.tolist(),
        *(camera.fx, camera.fy, camera.cx, camera.cy),
        -camera.cx / camera.fx - beyond_x,
        (camera.width - camera.cx) / camera.fx + beyond_x,
        -camera.cy / camera.fy - beyond_y,
        (camera.height - camera.cy) / camera.fy + beyond_y,
    ]
    return [float(number) for number in numbers]


class Buffers:
    """Named memory on a device that is reused and grows. Its contents are undefined when it is taken."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.memory: dict[str, Tensor] = {}

    def take(self, name: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Return a contiguous tensor of this shape in the memory called ``name``."""
        size = math.prod(shape)
        memory = self.memory.get(name)
        if memory is None or memory.numel() < size or memory.dtype != dtype:
            # A quarter more than needed, so that slow growth does not allocate at every step. The old memory
            # is freed first, so that both need not fit at once.
            grows = memory is not None
            self.memory.pop(name, None)
            del memory
            memory = torch.empty(size + size // 4 if grows else size, dtype=dtype, device=self.device)
            self.memory[name] = memory
        return memory[:size].view(shape)


@dataclass(frozen=True, eq=False)
class ForwardPass:
    """State of a forward pass that the backward pass needs; each back end adds its own."""

    gaussians: Gaussians
    camera: Camera
    sh_count: int
    antialias: bool
    own_poses: Tensor | None
    """Pose of each Gaussian with a rolling shutter, [N, 12]: see `cleargs.splat.rolling`."""


class Rasteriser(ABC):
    """Renderer of float32 Gaussians with gradients, which reuses its buffers.

    Returned tensors are views into these buffers: they are valid until the next call of the same method.
    Results are bitwise the same for any number of threads, and from run to run on one GPU.
    """

    pair_buffers: ClassVar[tuple[str, ...]]
    """Names of the buffers that grow with the number of (tile, splat) pairs."""
    pair_bytes: ClassVar[int]
    """Bytes per pair in these buffers and in temporary memory."""

    def __init__(self, device: torch.device) -> None:
        self._buffers = Buffers(device)
        self._state: Any = None
        self.radii: Tensor = torch.empty(0, device=device)
        """Radius of each splat in the last view, [N] px; 0 = not visible."""

    @property
    def visible(self) -> Tensor:
        """Gaussians that reach alpha 1/255 in a tile of the last view, [N] bool."""
        return self.radii > 0

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
        """Render a view of Gaussians on the rasteriser's device, as `cleargs.splat.render.render` does.

        The parameters are read in place: do not change them between ``forward`` and ``backward``. Without
        ``depth`` the depth of the result is None.
        """
        if gaussians.means.dtype != torch.float32:
            raise InputError(
                f"the kernels need float32 parameters, but these are {gaussians.means.dtype}",
                hint="convert each of the five parameters with .float()",
            )
        inputs = ForwardPass(
            gaussians.detach(),
            camera,
            sh_count(gaussians, sh_degree),
            antialias,
            self._own_poses(gaussians.means, camera),
        )
        with self._launching():
            self._state = self._bin(inputs, background, depth)
            return self._blend(self._state, depth)

    def view(
        self, scene: Scene, camera: Camera, *, depth: bool = False, sh_degree: int | None = None
    ) -> Render:
        """Render a view with the background and anti-aliasing of the scene; see `forward`."""
        return self.forward(
            scene.gaussians,
            camera,
            sh_degree=sh_degree,
            background=scene.background,
            antialias=scene.antialias,
            depth=depth,
        )

    def backward(
        self,
        grad_image: Tensor,  # [H, W, 3]
        grad_alpha: Tensor | None = None,  # [H, W]
        grad_depth: Tensor | None = None,  # [H, W]
    ) -> Gaussians:
        """Return the gradients of the parameters from those of the last image, alpha and depth (None: zeros).

        Gaussians that are not visible, and SH coefficients above the degree in use, get exactly 0.

        Raises:
            RuntimeError: There was no ``forward`` before.
            ValueError: ``grad_image`` does not have the shape of the image, or ``grad_depth`` is given for a
                camera whose shutter rolls.
        """
        if self._state is None:
            raise RuntimeError("backward() needs a call of forward() before it")
        camera: Camera = self._state.camera
        expected = (camera.height, camera.width, 3)
        if tuple(grad_image.shape) != expected:
            raise ValueError(f"grad_image has the shape {tuple(grad_image.shape)}, expected {expected}")
        if grad_depth is not None and camera.readout is not None:
            raise ValueError("the depth of a camera whose shutter rolls has no gradient")
        with self._launching():
            return self._differentiate(
                self._state,
                grad_image.detach().contiguous(),
                None if grad_alpha is None else grad_alpha.detach().contiguous(),
                None if grad_depth is None else grad_depth.detach().contiguous(),
            )

    def _own_poses(self, means: Tensor, camera: Camera) -> Tensor | None:
        """Return the pose of the camera for each Gaussian: see `cleargs.splat.rolling`."""
        return own_poses(means, camera)

    @abstractmethod
    def _launching(self) -> AbstractContextManager[Any]:
        """Return the context in which the kernels of a pass run."""

    @abstractmethod
    def _bin(self, inputs: ForwardPass, background: tuple[float, float, float], depth: bool) -> ForwardPass:
        """Project the Gaussians into splats, and list the splats of each tile from near to far."""

    @abstractmethod
    def _blend(self, state: Any, depth: bool) -> Render:
        """Blend the splats of each pixel."""

    @abstractmethod
    def _differentiate(
        self, state: Any, grad_image: Tensor, grad_alpha: Tensor | None, grad_depth: Tensor | None
    ) -> Gaussians:
        """Return the gradients of the parameters; those of the outputs are contiguous."""

    def _require_memory(self, pairs: int, camera: Camera) -> None:
        """Raise StageError if there are too many pairs to number, or if their buffers would not fit."""
        memory = self._buffers.memory
        missing = pairs * self.pair_bytes - sum(memory[n].nbytes for n in self.pair_buffers if n in memory)
        if pairs > MAX_PAIRS:
            excess = f"more than the limit of {MAX_PAIRS:.2e}"
        elif missing > UNCHECKED_BYTES and missing > available_memory(self._buffers.device):
            excess = f"more than fit: they need another {missing / 1e9:.1f} GB of the device's memory"
        else:
            return
        raise StageError(
            f"{int(self.visible.sum())} Gaussians give {pairs:.2e} (tile, splat) pairs at "
            f"{camera.width}x{camera.height}, {excess}",
            hint="lower the resolution or the number of Gaussians, or check for exploded scales",
        )
