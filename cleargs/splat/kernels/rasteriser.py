"""What the rasterisers of both back ends share: interface, reusable buffers, limit on memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
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
from cleargs.splat.scene import Scene
from cleargs.splat.types import Render

UNCHECKED_BYTES = 2**28
"""Bytes that are taken without asking how many are left, which takes about a millisecond."""


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


def tiles_of(camera: Camera) -> int:
    """Number of tiles of an image."""
    return -(-camera.width // TILE) * -(-camera.height // TILE)


def view_numbers(camera: Camera) -> list[float]:
    """A camera as the kernels read it: rotation rows and translation from the world to it, centre,
    intrinsics, and gsplat's bounds of x/z and y/z in the Jacobian (left, right, top, bottom).
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
    """Named memory on a device that grows and is used again; contents are undefined when taken."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.memory: dict[str, Tensor] = {}

    def take(self, name: str, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """A contiguous tensor of this shape in the memory called ``name``."""
        size = 1
        for side in shape:
            size *= side
        memory = self.memory.get(name)
        if memory is None or memory.numel() < size or memory.dtype != dtype:
            # A quarter more than asked for, so that slow growth does not allocate at every step. What was
            # there is given back first: it need not fit beside what replaces it.
            grows = memory is not None
            self.memory.pop(name, None)
            del memory
            memory = torch.empty(size + size // 4 if grows else size, dtype=dtype, device=self.device)
            self.memory[name] = memory
        return memory[:size].view(shape)

    def held(self, names: Iterable[str]) -> int:
        """Bytes of the memory called so."""
        return sum(self.memory[name].nbytes for name in names if name in self.memory)


@dataclass(frozen=True, eq=False)
class ForwardPass:
    """What the backward pass needs of one forward pass; each back end adds its own."""

    gaussians: Gaussians
    camera: Camera
    sh_count: int
    antialias: bool


class Rasteriser(ABC):
    """Renders float32 Gaussians and differentiates the picture, with buffers kept from call to call.

    Everything returned is a view into these buffers and valid until the next call of the same method.
    Results are bitwise the same for any number of threads, and from run to run on one GPU.
    """

    pair_buffers: ClassVar[tuple[str, ...]]
    """The buffers that grow with the (tile, splat) pairs."""
    pair_bytes: ClassVar[int]
    """What a pair takes in them, and for a while beside them."""

    def __init__(self, device: torch.device) -> None:
        self._buffers = Buffers(device)
        self._state: Any = None
        self.radii: Tensor = torch.empty(0, device=device)
        """[N] px, 0 = not visible; of the last forward pass."""

    @property
    def visible(self) -> Tensor:
        """[N] bool: the Gaussians that reach alpha 1/255 at a pixel's tile in the last view."""
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
        """Render a view; ``depth`` is None unless asked for. The arguments are those of ``render``.

        The parameters are read in place: do not change them between ``forward`` and ``backward``.

        Raises:
            InputError: when the parameters are not float32 or the SH degree is not stored.
            StageError: when there are more (tile, splat) pairs than 2^31 - 1, or than fit in memory.
        """
        if gaussians.means.dtype != torch.float32:
            raise InputError(
                f"the kernels take float32 parameters, not {gaussians.means.dtype}",
                hint="convert each of the five with .float()",
            )
        inputs = ForwardPass(gaussians.detach(), camera, sh_count(gaussians, sh_degree), antialias)
        with self._launching():
            self._state = self._bin(inputs, background, depth)
            return self._blend(self._state, depth)

    def view(
        self, scene: Scene, camera: Camera, *, depth: bool = False, sh_degree: int | None = None
    ) -> Render:
        """Render a view as the scene is meant to be rendered; see `forward`."""
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
        """Gradients of the five parameters of the last ``forward``.

        Gaussians that are not visible, and SH coefficients above the degree in use, get exactly 0.
        """
        if self._state is None:
            raise RuntimeError("backward() needs a forward() before it")
        camera: Camera = self._state.camera
        expected = (camera.height, camera.width, 3)
        if tuple(grad_image.shape) != expected:
            raise ValueError(f"grad_image has the shape {tuple(grad_image.shape)}, expected {expected}")
        with self._launching():
            return self._differentiate(
                self._state,
                grad_image.detach().contiguous(),
                None if grad_alpha is None else grad_alpha.detach().contiguous(),
                None if grad_depth is None else grad_depth.detach().contiguous(),
            )

    @abstractmethod
    def _launching(self) -> AbstractContextManager[Any]:
        """What surrounds the kernels of a pass."""

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
        """Gradients of the parameters, from contiguous ones of what was rendered."""

    def _require_memory(self, pairs: int, camera: Camera) -> None:
        """Raise StageError when this many pairs cannot be numbered, or their buffers would not fit."""
        missing = pairs * self.pair_bytes - self._buffers.held(self.pair_buffers)
        if pairs > MAX_PAIRS:
            excess = f"more than {MAX_PAIRS:.2e}"
        elif missing > UNCHECKED_BYTES and missing > available_memory(self._buffers.device):
            excess = f"more than fit: they need another {missing / 1e9:.1f} GB of the device's memory"
        else:
            return
        raise StageError(
            f"{int(self.visible.sum())} Gaussians touch {pairs:.2e} (tile, splat) pairs at "
            f"{camera.width}x{camera.height}, {excess}",
            hint="lower the resolution or the number of Gaussians, or check for exploded scales",
        )
