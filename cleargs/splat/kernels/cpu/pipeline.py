"""The CPU rasteriser: projection, binning and rasterisation over reusable buffers."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cleargs.errors import StageError
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu import binning, gradients, launch, projection, rasterise
from cleargs.splat.kernels.cpu.jit import Array, Floats
from cleargs.splat.kernels.memory import available_memory
from cleargs.splat.kernels.splat_layout import (
    BEND_X,
    BEND_Y,
    MAX_PAIRS,
    PAIR_COLUMNS,
    SKEW,
    SPLAT_COLUMNS,
    SUM_DEPTH,
    SUM_VU,
    SUM_VY,
    TILE,
)

PAIR_BUFFERS = ("pair_tiles", "pair_ids", "pair_slots", "pair_sums")
PAIR_BYTES = 4 * (3 + SUM_DEPTH)
"""What a (tile, splat) pair takes in them: its tile, Gaussian, slot and, when it is trained, its sums."""

UNASKED = 2**28
"""Bytes that are taken without asking how many are left, which takes about a millisecond."""


@dataclass
class Buffers:
    """Named arrays that grow and are used again; contents are undefined when taken."""

    arrays: dict[str, Array] = field(default_factory=dict)

    def take(self, name: str, shape: tuple[int, ...], dtype: Any = np.float32) -> Array:
        """A C-contiguous array of this shape in the memory called ``name``."""
        size = int(np.prod(shape, dtype=np.int64))
        memory = self.arrays.get(name)
        if memory is None or memory.size < size:
            # A quarter more than asked for, so that slow growth does not allocate at every step.
            memory = np.empty(size if memory is None else size + size // 4, dtype)
            self.arrays[name] = memory
        return memory[:size].reshape(shape)

    def held(self, names: Iterable[str]) -> int:
        """Bytes of the memory called so."""
        return sum(self.arrays[name].nbytes for name in names if name in self.arrays)


@dataclass(frozen=True)
class Frame:
    """What the backward pass needs of one forward pass."""

    gaussians: Gaussians
    camera: Camera
    view: projection.View
    sh_count: int
    antialias: bool
    background: Floats  # [3]
    splats: Floats  # [N, 16]
    pair_offsets: Array  # [N + 1]
    tile_offsets: Array  # [tiles + 1]
    pair_ids: Array  # [P]
    pair_slots: Array  # [P]
    transmittance: Floats  # [H, W]
    last: Floats  # [H, W]


def read(tensor: Tensor) -> Array:
    """A contiguous NumPy view of a CPU tensor, outside autograd."""
    array: Array = tensor.detach().contiguous().numpy()
    return array


def read_parameters(gaussians: Gaussians) -> tuple[Array, Array, Array, Array, Array]:
    """Views of the five parameters in the order in which the kernels take them."""
    return (
        read(gaussians.means),
        read(gaussians.log_scales),
        read(gaussians.rotations),
        read(gaussians.logit_opacities),
        read(gaussians.sh),
    )


class CpuRasteriser:
    """Forward and backward passes on the CPU.

    Outputs are views into buffers that the next call overwrites. ``radii`` [N] in px (0 = not visible)
    belongs to the last forward pass.
    """

    def __init__(self) -> None:
        self._buffers = Buffers()
        self._frame: Frame | None = None
        self._pair_sums: Array | None = None
        self.radii: Tensor = torch.empty(0)

    def forward(
        self,
        gaussians: Gaussians,
        camera: Camera,
        *,
        sh_count: int,
        background: tuple[float, float, float],
        antialias: bool,
        depth: bool,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Image [H, W, 3], alpha [H, W] and, when asked for, depth [H, W]."""
        with launch.exclusive():
            frame = self._project_and_bin(gaussians, camera, sh_count, background, antialias)
            shape = (camera.height, camera.width)
            image = self._buffers.take("image", (*shape, 3))
            depths = self._buffers.take("depth", shape) if depth else None
            with launch.uneven_work():
                rasterise.forward(
                    camera.width,
                    camera.height,
                    frame.tile_offsets,
                    frame.pair_ids,
                    frame.splats,
                    frame.background,
                    image,
                    frame.transmittance,
                    frame.last,
                    depths,
                )
        self._frame, self._pair_sums = frame, None
        alpha = np.subtract(np.float32(1), frame.transmittance, out=self._buffers.take("alpha", shape))
        return (
            torch.from_numpy(image),
            torch.from_numpy(alpha),
            None if depths is None else torch.from_numpy(depths),
        )

    def backward(self, grad_image: Tensor, grad_alpha: Tensor | None, grad_depth: Tensor | None) -> Gaussians:
        """Gradients of the five parameters for the last forward pass."""
        frame = self._frame
        if frame is None:
            raise RuntimeError("backward() needs a forward() before it")
        shape = (frame.camera.height, frame.camera.width)
        if tuple(grad_image.shape) != (*shape, 3):
            raise ValueError(f"grad_image has the shape {tuple(grad_image.shape)}, expected {(*shape, 3)}")
        columns = SUM_DEPTH if grad_depth is None else PAIR_COLUMNS
        pair_sums = self._buffers.take("pair_sums", (len(frame.pair_ids), columns))
        parameters = read_parameters(frame.gaussians)
        names = ("grad_means", "grad_log_scales", "grad_rotations", "grad_logits", "grad_sh")
        outputs = [
            self._buffers.take(name, array.shape) for name, array in zip(names, parameters, strict=True)
        ]
        with launch.exclusive():
            with launch.uneven_work():
                rasterise.backward(
                    frame.camera.width,
                    frame.camera.height,
                    frame.tile_offsets,
                    frame.pair_ids,
                    frame.pair_slots,
                    frame.splats,
                    frame.background,
                    frame.transmittance,
                    frame.last,
                    read(grad_image),
                    None if grad_alpha is None else read(grad_alpha),
                    None if grad_depth is None else read(grad_depth),
                    pair_sums,
                )
            gradients.backpropagate(
                *parameters,
                frame.sh_count,
                frame.view,
                frame.antialias,
                frame.splats,
                frame.pair_offsets,
                pair_sums,
                *outputs,
            )
        self._pair_sums = pair_sums
        return Gaussians(*(torch.from_numpy(output) for output in outputs))

    def screen_gradients(self) -> Tensor:
        """dL/d(projected mean) [N, 2] of the last backward pass, by px; 0 where not visible."""
        frame, sums = self._frame, self._pair_sums
        if frame is None or sums is None or len(sums) != len(frame.pair_ids):
            raise RuntimeError("screen_gradients() needs a backward() before it")
        pairs = np.diff(frame.pair_offsets)
        shown = np.flatnonzero(pairs)
        owner = np.repeat(np.arange(len(shown)), pairs[shown])
        u, v = (np.bincount(owner, sums[:, column], len(shown)) for column in (SUM_VU, SUM_VY))  # float64
        # a, e and k are those of `splat_layout`; BEND_X is a log2(e) / 2.
        splats = frame.splats[shown]
        x = 2.0 * math.log(2.0) * splats[:, BEND_X] * u
        y = 2.0 * math.log(2.0) * splats[:, BEND_Y] * v - splats[:, SKEW] * x
        gradient = np.zeros((len(pairs), 2), np.float32)
        gradient[shown] = np.stack([x, y], axis=1)
        return torch.from_numpy(gradient)

    def _project_and_bin(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_count: int,
        background: tuple[float, float, float],
        antialias: bool,
    ) -> Frame:
        n, width, height = gaussians.num, camera.width, camera.height
        view = projection.view_of(camera)
        splats = self._buffers.take("splats", (n, SPLAT_COLUMNS))
        tile_counts = self._buffers.take("tile_counts", (n,), np.int64)
        radii = self._buffers.take("radii", (n,))
        projection.project(
            *read_parameters(gaussians), sh_count, view, antialias, width, height, splats, tile_counts, radii
        )
        self.radii = torch.from_numpy(radii)

        pair_offsets = self._buffers.take("pair_offsets", (n + 1,), np.int64)
        visible = binning.pair_ranges(tile_counts, pair_offsets)
        pairs = int(pair_offsets[n])
        self._require_memory(pairs, visible, camera)
        keys = self._buffers.take("keys", (2, visible), np.uint32)
        ids = self._buffers.take("ids", (2, visible), np.uint32)
        order = ids[binning.depth_order(splats, tile_counts, keys, ids)]
        pair_tiles = self._buffers.take("pair_tiles", (pairs,), np.uint32)
        binning.list_pairs(splats, pair_offsets, width, height, pair_tiles)
        tiles = -(-width // TILE) * -(-height // TILE)
        counts = self._buffers.take("counts", (launch.threads(), tiles), np.int64)
        tile_offsets = self._buffers.take("tile_offsets", (tiles + 1,), np.int64)
        pair_ids = self._buffers.take("pair_ids", (pairs,), np.uint32)
        pair_slots = self._buffers.take("pair_slots", (pairs,), np.uint32)
        binning.sort_pairs_by_tile(
            order, pair_offsets, pair_tiles, counts, tile_offsets, pair_ids, pair_slots
        )
        return Frame(
            gaussians=gaussians,
            camera=camera,
            view=view,
            sh_count=sh_count,
            antialias=antialias,
            background=np.asarray(background, np.float32),
            splats=splats,
            pair_offsets=pair_offsets,
            tile_offsets=tile_offsets,
            pair_ids=pair_ids,
            pair_slots=pair_slots,
            transmittance=self._buffers.take("transmittance", (height, width)),
            last=self._buffers.take("last", (height, width)),
        )

    def _require_memory(self, pairs: int, visible: int, camera: Camera) -> None:
        """Raise StageError when this many pairs cannot be numbered, or their buffers would not fit."""
        missing = pairs * PAIR_BYTES - self._buffers.held(PAIR_BUFFERS)
        if pairs > MAX_PAIRS:
            excess = f"more than {MAX_PAIRS:.2e}"
        elif missing > UNASKED and missing > available_memory():
            excess = f"more than fit: they need another {missing / 1e9:.1f} GB of memory"
        else:
            return
        raise StageError(
            f"{visible} Gaussians touch {pairs:.2e} (tile, splat) pairs at {camera.width}x{camera.height}, "
            f"{excess}",
            hint="lower the resolution or the number of Gaussians, or check for exploded scales",
        )
