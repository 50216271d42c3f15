"""The CPU rasteriser: projection, binning and rasterisation over reusable buffers."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels import rasteriser
from cleargs.splat.kernels.cpu import binning, gradients, projection, rasterise, rolling
from cleargs.splat.kernels.cpu.jit import LAUNCHING
from cleargs.splat.kernels.splat_layout import PAIR_COLUMNS, SPLAT_COLUMNS, SUM_DEPTH
from cleargs.splat.types import Render
from cleargs.types import AnyArray, ArrayF32

TILES_PER_CHUNK = 8
"""Tiles that a thread takes at a time. Tiles differ in cost, so each thread needs many small portions."""


@dataclass(frozen=True, eq=False)
class CpuForwardPass(rasteriser.ForwardPass):
    """State of a forward pass that the backward pass needs."""

    view: projection.ProjectionView
    background: ArrayF32  # [3]
    splats: ArrayF32  # [N, 16], columns of splat_layout
    pair_offsets: AnyArray  # [N + 1], first pair of each Gaussian
    tile_offsets: AnyArray  # [tiles + 1], first pair of each tile
    pair_ids: AnyArray  # [P], Gaussian of each pair
    pair_slots: AnyArray  # [P], row of each pair in the pair sums
    transmittance: ArrayF32  # [H, W]
    last: ArrayF32  # [H, W], number of the last splat that contributed, from 1


def read_parameters(gaussians: Gaussians) -> projection.Parameters:
    """Return views of the five parameters in the order of the kernels."""
    return tuple(tensor.detach().contiguous().numpy() for tensor in gaussians.tensors().values())


def _poses(inputs: rasteriser.ForwardPass) -> AnyArray:
    return np.empty((0, 12)) if inputs.own_poses is None else inputs.own_poses.numpy()


class CpuRasteriser(rasteriser.Rasteriser):
    """The rasteriser on the CPU."""

    pair_buffers = ("pair_tiles", "pair_ids", "pair_slots", "pair_sums")
    pair_bytes = 4 * (3 + SUM_DEPTH)  # tile, Gaussian, slot and, in training, sums

    def __init__(self) -> None:
        super().__init__(torch.device("cpu"))

    def _own_poses(self, means: Tensor, camera: Camera) -> Tensor | None:
        readout = camera.readout
        if readout is None:
            return None
        pose, out = np.ascontiguousarray(camera.world_to_camera[:3]), np.empty((len(means), 12))
        twists = tuple(tuple(twist) for twist in readout.twists.tolist())
        places = readout.slope, readout.start, int(not readout.columns)
        with LAUNCHING:
            rolling.own_poses(means.detach().contiguous().numpy(), pose, twists, *places, out)
        return torch.from_numpy(out)

    def _launching(self) -> AbstractContextManager[Any]:
        return LAUNCHING

    def _floats(self, name: str, *shape: int) -> ArrayF32:
        return self._buffers.take(name, *shape).numpy()

    def _integers(self, name: str, *shape: int) -> AnyArray:  # int64
        return self._buffers.take(name, *shape, dtype=torch.int64).numpy()

    def _numbers(self, name: str, *shape: int) -> AnyArray:  # uint32
        return self._buffers.take(name, *shape, dtype=torch.int32).numpy().view(np.uint32)

    def _bin(
        self, inputs: rasteriser.ForwardPass, background: tuple[float, float, float], depth: bool
    ) -> CpuForwardPass:
        gaussians, camera = inputs.gaussians, inputs.camera
        n, width, height = gaussians.num, camera.width, camera.height
        view = projection.ProjectionView(*rasteriser.view_numbers(camera))
        splats = self._floats("splats", n, SPLAT_COLUMNS)
        tile_counts = self._integers("tile_counts", n)
        radii = self._floats("radii", n)
        projection.project(
            *(read_parameters(gaussians), inputs.sh_count, view, _poses(inputs), inputs.antialias),
            *(width, height),
            *(splats, tile_counts, radii),
        )
        self.radii = torch.from_numpy(radii)

        pair_offsets = self._integers("pair_offsets", n + 1)
        visible = binning.pair_ranges(tile_counts, pair_offsets)
        pairs = int(pair_offsets[n])
        self._require_memory(pairs, camera)
        keys, ids = self._numbers("keys", 2, visible), self._numbers("ids", 2, visible)
        counts = self._integers("depth_counts", numba.get_num_threads(), binning.RADIX)
        order = ids[binning.depth_order(splats, tile_counts, counts, keys, ids)]
        pair_tiles = self._numbers("pair_tiles", pairs)
        binning.list_pairs(splats, pair_offsets, width, height, pair_tiles)
        tiles = rasteriser.tiles_of(camera)
        counts = self._integers("counts", numba.get_num_threads(), tiles)
        tile_offsets = self._integers("tile_offsets", tiles + 1)
        pair_ids, pair_slots = self._numbers("pair_ids", pairs), self._numbers("pair_slots", pairs)
        binning.sort_pairs_by_tile(
            order, pair_offsets, pair_tiles, counts, tile_offsets, pair_ids, pair_slots
        )
        return CpuForwardPass(
            **vars(inputs),
            view=view,
            background=np.asarray(background, np.float32),
            splats=splats,
            pair_offsets=pair_offsets,
            tile_offsets=tile_offsets,
            pair_ids=pair_ids,
            pair_slots=pair_slots,
            transmittance=self._floats("transmittance", height, width),
            last=self._floats("last", height, width),
        )

    def _blend(self, state: CpuForwardPass, depth: bool) -> Render:
        width, height = state.camera.width, state.camera.height
        image = self._floats("image", height, width, 3)
        depths = self._floats("depth", height, width) if depth else None
        with numba.parallel_chunksize(TILES_PER_CHUNK):
            rasterise.forward(
                *(width, height, state.tile_offsets, state.pair_ids, state.splats, state.background),
                *(image, state.transmittance, state.last, depths),
            )
        alpha = np.subtract(np.float32(1), state.transmittance, out=self._floats("alpha", height, width))
        return Render(
            torch.from_numpy(image),
            torch.from_numpy(alpha),
            None if depths is None else torch.from_numpy(depths),
        )

    def _differentiate(
        self, state: CpuForwardPass, grad_image: Tensor, grad_alpha: Tensor | None, grad_depth: Tensor | None
    ) -> Gaussians:
        columns = SUM_DEPTH if grad_depth is None else PAIR_COLUMNS
        pair_sums = self._floats("pair_sums", len(state.pair_ids), columns)
        with numba.parallel_chunksize(TILES_PER_CHUNK):
            rasterise.backward(
                *(state.camera.width, state.camera.height, state.tile_offsets, state.pair_ids),
                *(state.pair_slots, state.splats, state.background, state.transmittance),
                *(state.last, grad_image.numpy()),
                None if grad_alpha is None else grad_alpha.numpy(),
                None if grad_depth is None else grad_depth.numpy(),
                pair_sums,
            )
        parameters = state.gaussians.tensors()
        outputs = {name: self._floats(f"grad_{name}", *value.shape) for name, value in parameters.items()}
        gradients.backpropagate(
            *(read_parameters(state.gaussians), state.sh_count, state.view, _poses(state), state.antialias),
            *(state.splats, state.pair_offsets, pair_sums, tuple(outputs.values())),
        )
        return Gaussians(**{name: torch.from_numpy(output) for name, output in outputs.items()})
