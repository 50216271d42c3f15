"""The GPU rasteriser: projection, binning and rasterisation over reusable buffers.

A forward pass waits for the device once, for the number of (tile, splat) pairs. Nothing else waits.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels import rasteriser
from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cuda import binning, device_layout, gradients, projection, rasterise
from cleargs.splat.kernels.cuda.device_layout import LIST_BLOCK, PLACE_BLOCK, PROJECT_BLOCK, TOTAL_ROWS
from cleargs.splat.kernels.cuda.support import memory_errors
from cleargs.splat.kernels.rasteriser import tiles_of
from cleargs.splat.types import Render

FORWARD_WARPS = 2
"""Warps per tile, forward: four pixels per lane."""
BACKWARD_WARPS = 1
"""Warps per chunk, backward: with one, sums over pixels need shuffles and no barrier."""

PAIR_BYTES = 4 * (
    4 + layout.PAIR_COLUMNS + layout.TILE_PIXELS * (device_layout.CHUNK_PLANES + 1) // device_layout.CHUNK
)
"""Bytes per (tile, splat) pair in buffers, with its share of a full chunk."""
SORT_BYTES = 24
"""Bytes per pair while pairs are sorted by tile: key and number, twice."""

KEPT_VIEWS = 4096
"""Cameras whose numbers stay on the device, at most; each takes 512 bytes."""


@dataclass(frozen=True, eq=False)
class CudaForwardPass(rasteriser.ForwardPass):
    """Data that the backward pass needs from one forward pass."""

    view: Tensor  # float64 [23]
    background: tuple[float, float, float]
    planes: int  # planes per chunk
    splats: Tensor  # [N, 16]
    tile_counts: Tensor  # [N] int32
    reached: Tensor  # [N] int32, see ``rasterise.forward``
    pair_starts: Tensor  # [N] int32, first slot of each Gaussian
    pair_ids: Tensor  # [P] int32, the Gaussian of each place
    pair_slots: Tensor  # [P] int32
    tile_starts: Tensor  # [tiles + 1] int32
    chunk_tiles: Tensor  # [C] int32
    chunk_planes: Tensor  # [C, planes, 256]
    deepest: Tensor  # [tiles] int32
    transmittance: Tensor  # [H, W]
    last: Tensor  # [H, W] int32


def _poses(inputs: rasteriser.ForwardPass, view: Tensor) -> Tensor:
    """Return the Gaussians' own poses; without a rolling shutter a tensor that the kernels do not read."""
    return view if inputs.own_poses is None else inputs.own_poses


class CudaRasteriser(rasteriser.Rasteriser):
    """Forward and backward passes on a GPU, or on the CPU in Triton's interpreter."""

    pair_buffers = (
        *("pair_tiles", "pair_owners", "pair_ids", "pair_slots", "pair_sums"),
        *("chunk_planes", "chunk_behind"),
    )
    pair_bytes = PAIR_BYTES + SORT_BYTES

    def __init__(self, device: torch.device) -> None:
        super().__init__(device)
        self._views: dict[tuple[float, ...], Tensor] = {}

    def _view(self, camera: Camera) -> Tensor:
        """Return the numbers of a camera on the device, float64 [23]. They are copied once per camera."""
        numbers = tuple(rasteriser.view_numbers(camera))
        if numbers not in self._views:
            if len(self._views) >= KEPT_VIEWS:
                self._views.clear()
            view = torch.tensor(numbers, dtype=torch.float64)
            self._views[numbers] = view.to(self._buffers.device, non_blocking=True)
        return self._views[numbers]

    def _launching(self) -> AbstractContextManager[Any]:
        return memory_errors()

    def _blend(self, state: CudaForwardPass, depth: bool) -> Render:
        take, camera = self._buffers.take, state.camera
        shape = (camera.height, camera.width)
        image, alpha = take("image", *shape, 3), take("alpha", *shape)
        depths = take("depth", *shape) if depth else None
        rasterise.forward[(tiles_of(camera),)](
            *(state.tile_starts, state.pair_ids, state.splats, *state.background),
            *(image, alpha, state.transmittance, state.last, alpha if depths is None else depths),
            *(state.chunk_planes, state.chunk_tiles, state.deepest, state.reached),
            *(camera.width, camera.height),
            WITH_DEPTH=depth,
            PLANES=state.planes,
            num_warps=FORWARD_WARPS,
        )
        return Render(image, alpha, depths)

    def _differentiate(
        self, state: CudaForwardPass, grad_image: Tensor, grad_alpha: Tensor | None, grad_depth: Tensor | None
    ) -> Gaussians:
        if grad_depth is not None and state.planes == device_layout.CHUNK_PLANES:
            raise ValueError("a gradient of the depth needs a forward(depth=True) before it")
        take, camera, tiles = self._buffers.take, state.camera, tiles_of(state.camera)
        pairs, chunks, n = len(state.pair_ids), len(state.chunk_tiles), state.gaussians.num
        columns = layout.SUM_DEPTH if grad_depth is None else layout.PAIR_COLUMNS
        chunk_behind = take("chunk_behind", chunks, layout.TILE_PIXELS)
        pair_sums = take("pair_sums", max(pairs, 1), layout.PAIR_COLUMNS)
        by_alpha, by_depth = (grad_image if grad is None else grad for grad in (grad_alpha, grad_depth))
        given: dict[str, Any] = {"HAS_DEPTH": grad_depth is not None, "PLANES": state.planes}
        rasterise.behind[(tiles,)](
            *(state.tile_starts, state.chunk_planes, state.deepest, *state.background, state.transmittance),
            *(grad_image, by_alpha, by_depth, chunk_behind, camera.width, camera.height),
            HAS_ALPHA=grad_alpha is not None,
            **given,
            num_warps=4,
        )
        if pairs:
            rasterise.backward[(chunks,)](
                *(state.tile_starts, state.chunk_tiles, state.chunk_planes, chunk_behind, state.deepest),
                *(state.pair_ids, state.pair_slots, state.splats, state.last, grad_image, by_depth),
                *(pair_sums, state.reached, camera.width, camera.height),
                COLUMNS=columns,
                **given,
                num_warps=BACKWARD_WARPS,
            )
        parameters = state.gaussians.tensors()
        outputs = {name: take(f"grad_{name}", *value.shape) for name, value in parameters.items()}
        if n:
            totals = take("totals", layout.PAIR_COLUMNS, n, dtype=torch.float64)
            gradients.total[(-(-n // TOTAL_ROWS),)](
                *(state.tile_counts, state.reached, state.pair_starts, pair_sums, totals, n),
                COLUMNS=columns,
                num_warps=4,
            )
            gradients.backpropagate[(-(-n // PROJECT_BLOCK),)](
                *(value.contiguous() for value in parameters.values()),
                *(state.view, _poses(state, state.view), state.splats, state.reached, totals),
                *(*outputs.values(), n),
                SH_STORED=state.gaussians.sh.shape[1],
                SH_COUNT=state.sh_count,
                ANTIALIAS=state.antialias,
                HAS_DEPTH=grad_depth is not None,
                ROLLS=state.own_poses is not None,
                num_warps=4,
            )
        return Gaussians(**outputs)

    def _bin(
        self, inputs: rasteriser.ForwardPass, background: tuple[float, float, float], depth: bool
    ) -> CudaForwardPass:
        gaussians, camera = inputs.gaussians, inputs.camera
        take = self._buffers.take
        n, width, height, tiles = gaussians.num, camera.width, camera.height, tiles_of(camera)
        view = self._view(camera)
        splats = take("splats", n, layout.SPLAT_COLUMNS)
        depth_keys, self.radii = take("depth_keys", n), take("radii", n)
        tile_counts = take("tile_counts", n, dtype=torch.int32)
        reached = take("reached", n, dtype=torch.int32)
        pair_starts = take("pair_starts", n, dtype=torch.int32)
        if n:
            projection.project[(-(-n // PROJECT_BLOCK),)](
                *(value.contiguous() for value in gaussians.tensors().values()),
                *(view, _poses(inputs, view), splats, depth_keys, tile_counts, reached, self.radii),
                *(n, width, height),
                SH_STORED=gaussians.sh.shape[1],
                SH_COUNT=inputs.sh_count,
                ANTIALIAS=inputs.antialias,
                ROLLS=inputs.own_poses is not None,
                num_warps=4,
                enable_fp_fusion=False,
            )
        order = torch.sort(depth_keys, stable=True).indices
        pair_ends = tile_counts[order].cumsum(0)
        pairs = int(pair_ends[-1]) if n else 0
        self._require_memory(pairs, camera)
        # The smallest type that holds all tile numbers and their end.
        pair_tiles = take("pair_tiles", pairs, dtype=torch.int16 if tiles < 2**15 - 1 else torch.int32)
        pair_owners = take("pair_owners", pairs, dtype=torch.int32)
        pair_ids = take("pair_ids", pairs, dtype=torch.int32)
        pair_slots = take("pair_slots", pairs, dtype=torch.int32)
        if pairs:
            binning.list_pairs[(-(-n // LIST_BLOCK),)](
                *(splats, order, tile_counts, pair_ends, pair_starts, pair_tiles, pair_owners),
                *(n, width, height),
                num_warps=1,
                enable_fp_fusion=False,
            )
        sorted_tiles, sorted_slots = torch.sort(pair_tiles, stable=True)
        tile_starts = take("tile_starts", tiles + 1, dtype=torch.int32)
        binning.place_pairs[(-(-max(pairs, tiles + 1) // PLACE_BLOCK),)](
            *(sorted_tiles, sorted_slots, pair_owners, pair_ids, pair_slots, tile_starts),
            *(pairs, tiles, pairs.bit_length()),
            num_warps=4,
        )
        planes = device_layout.CHUNK_PLANES + depth
        chunks = pairs // device_layout.CHUNK + tiles
        return CudaForwardPass(
            **vars(inputs),
            view=view,
            background=(float(background[0]), float(background[1]), float(background[2])),
            planes=planes,
            splats=splats,
            tile_counts=tile_counts,
            reached=reached,
            pair_starts=pair_starts,
            pair_ids=pair_ids,
            pair_slots=pair_slots,
            tile_starts=tile_starts,
            chunk_tiles=take("chunk_tiles", chunks, dtype=torch.int32),
            chunk_planes=take("chunk_planes", chunks, planes, layout.TILE_PIXELS),
            deepest=take("deepest", tiles, dtype=torch.int32),
            transmittance=take("transmittance", height, width),
            last=take("last", height, width, dtype=torch.int32),
        )
