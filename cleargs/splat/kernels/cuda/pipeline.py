"""The GPU rasteriser: projection, binning and rasterisation over reusable buffers.

A forward pass waits for the device once, to learn how many (tile, splat) pairs there are; nothing else waits.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from cleargs.errors import StageError
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cuda import binning, device_layout, gradients, projection, rasterise
from cleargs.splat.kernels.cuda.support import available_memory, memory_errors

FORWARD_WARPS = 2
"""Warps a tile forward: four pixels a lane."""
BACKWARD_WARPS = 1
"""Warps a chunk backward: with one, the sums over pixels need shuffles only and no barrier."""
PROJECT_BLOCK = 128
LIST_BLOCK = 32
ORDER_BLOCK = 1024
TOTAL_ROWS = 16
TOTAL_BLOCK = 16

PAIR_BUFFERS = (
    *("pair_tiles", "pair_owners", "pair_ids", "pair_slots", "pair_sums"),
    *("chunk_planes", "chunk_behind"),
)
PAIR_BYTES = 4 * (
    4 + layout.PAIR_COLUMNS + layout.TILE_PIXELS * (device_layout.CHUNK_PLANES + 1) // device_layout.CHUNK
)
"""What a (tile, splat) pair takes in them, its share of a full chunk included."""
SORT_BYTES = 24
"""What sorting it by tile takes for a while: key and number, twice."""

UNASKED = 2**28
"""Bytes that are taken without asking how many are left."""


@dataclass
class Buffers:
    """Named device memory that grows and is used again; contents are undefined when taken."""

    device: torch.device
    memory: dict[str, Tensor] = field(default_factory=dict)

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


@dataclass(frozen=True)
class Frame:
    """What the backward pass needs of one forward pass."""

    gaussians: Gaussians
    camera: Camera
    view: Tensor  # float64 [23]
    background: Tensor  # [3]
    sh_count: int
    antialias: bool
    planes: int  # planes a chunk
    splats: Tensor  # [N, 16]
    tile_counts: Tensor  # [N] int32
    pair_starts: Tensor  # [N] int32, first slot of each Gaussian
    pair_ids: Tensor  # [P] int32, the Gaussian of each place
    pair_slots: Tensor  # [P] int32
    tile_starts: Tensor  # [tiles + 1] int32
    chunk_starts: Tensor  # [tiles + 1] int32
    chunk_tiles: Tensor  # [C] int32
    chunk_planes: Tensor  # [C, planes, 256]
    deepest: Tensor  # [tiles] int32
    transmittance: Tensor  # [H, W]
    last: Tensor  # [H, W] int32


def tiles_of(camera: Camera) -> int:
    """Number of tiles of an image."""
    return -(-camera.width // layout.TILE) * -(-camera.height // layout.TILE)


class CudaRasteriser:
    """Forward and backward passes on a GPU, or on the CPU under Triton's interpreter.

    Outputs are views into buffers that the next call overwrites. ``radii`` [N] in px (0 = not visible)
    belongs to the last forward pass.
    """

    def __init__(self, device: torch.device) -> None:
        self._buffers = Buffers(device)
        self._frame: Frame | None = None
        self.radii: Tensor = torch.empty(0, device=device)

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
        with memory_errors():
            frame = self._project_and_bin(gaussians.detach(), camera, sh_count, background, antialias, depth)
            self._frame = frame
            take, shape = self._buffers.take, (camera.height, camera.width)
            image, alpha = take("image", *shape, 3), take("alpha", *shape)
            depths = take("depth", *shape) if depth else None
            rasterise.forward[(tiles_of(camera),)](
                frame.tile_starts,
                frame.chunk_starts,
                frame.pair_ids,
                frame.splats,
                frame.background,
                image,
                alpha,
                frame.transmittance,
                frame.last,
                alpha if depths is None else depths,
                frame.chunk_planes,
                frame.chunk_tiles,
                frame.deepest,
                camera.width,
                camera.height,
                WITH_DEPTH=depth,
                PLANES=frame.planes,
                num_warps=FORWARD_WARPS,
            )
        return image, alpha, depths

    def backward(self, grad_image: Tensor, grad_alpha: Tensor | None, grad_depth: Tensor | None) -> Gaussians:
        """Gradients of the five parameters for the last forward pass."""
        frame = self._frame
        if frame is None:
            raise RuntimeError("backward() needs a forward() before it")
        camera = frame.camera
        if tuple(grad_image.shape) != (camera.height, camera.width, 3):
            raise ValueError(
                f"grad_image has the shape {tuple(grad_image.shape)}, "
                f"expected {(camera.height, camera.width, 3)}"
            )
        if grad_depth is not None and frame.planes == device_layout.CHUNK_PLANES:
            raise ValueError("a gradient of the depth needs a forward(depth=True) before it")
        with memory_errors():
            return self._backward(
                frame,
                grad_image.contiguous(),
                None if grad_alpha is None else grad_alpha.contiguous(),
                None if grad_depth is None else grad_depth.contiguous(),
            )

    def _backward(
        self, frame: Frame, grad_image: Tensor, grad_alpha: Tensor | None, grad_depth: Tensor | None
    ) -> Gaussians:
        take, camera, tiles = self._buffers.take, frame.camera, tiles_of(frame.camera)
        pairs, chunks, n = len(frame.pair_ids), len(frame.chunk_tiles), frame.gaussians.num
        columns = layout.SUM_DEPTH if grad_depth is None else layout.PAIR_COLUMNS
        chunk_behind = take("chunk_behind", chunks, layout.TILE_PIXELS)
        pair_sums = take("pair_sums", max(pairs, 1), layout.PAIR_COLUMNS)
        rasterise.behind[(tiles,)](
            frame.chunk_starts,
            frame.chunk_planes,
            frame.deepest,
            frame.background,
            frame.transmittance,
            grad_image,
            grad_image if grad_alpha is None else grad_alpha,
            grad_image if grad_depth is None else grad_depth,
            chunk_behind,
            camera.width,
            camera.height,
            HAS_ALPHA=grad_alpha is not None,
            HAS_DEPTH=grad_depth is not None,
            PLANES=frame.planes,
            num_warps=4,
        )
        if pairs:
            rasterise.backward[(chunks,)](
                frame.tile_starts,
                frame.chunk_starts,
                frame.chunk_tiles,
                frame.chunk_planes,
                chunk_behind,
                frame.deepest,
                frame.pair_ids,
                frame.pair_slots,
                frame.splats,
                frame.last,
                grad_image,
                grad_image if grad_depth is None else grad_depth,
                pair_sums,
                tiles,
                camera.width,
                camera.height,
                HAS_DEPTH=grad_depth is not None,
                PLANES=frame.planes,
                COLUMNS=columns,
                num_warps=BACKWARD_WARPS,
            )
        parameters = frame.gaussians.tensors()
        outputs = {name: take(f"grad_{name}", *value.shape) for name, value in parameters.items()}
        if n:
            totals = take("totals", layout.PAIR_COLUMNS, n, dtype=torch.float64)
            gradients.total[(-(-n // TOTAL_ROWS),)](
                frame.tile_counts,
                frame.pair_starts,
                pair_sums,
                totals,
                n,
                COLUMNS=columns,
                ROWS=TOTAL_ROWS,
                BLOCK=TOTAL_BLOCK,
                num_warps=4,
            )
            gradients.backpropagate[(-(-n // PROJECT_BLOCK),)](
                *(value.contiguous() for value in parameters.values()),
                frame.view,
                frame.splats,
                frame.tile_counts,
                totals,
                *outputs.values(),
                n,
                SH_STORED=frame.gaussians.sh.shape[1],
                SH_COUNT=frame.sh_count,
                ANTIALIAS=frame.antialias,
                HAS_DEPTH=grad_depth is not None,
                BLOCK=PROJECT_BLOCK,
                num_warps=4,
            )
        return Gaussians(**outputs)

    def screen_gradients(self) -> Tensor:
        """dL/d(projected mean) [N, 2] of the last backward pass, by px; 0 where not visible."""
        frame = self._frame
        if frame is None:
            raise RuntimeError("screen_gradients() needs a backward() before it")
        totals = self._buffers.take("totals", layout.PAIR_COLUMNS, frame.gaussians.num, dtype=torch.float64)
        seen = frame.tile_counts > 0  # elsewhere nothing was written
        # a, e and k are those of `layout`; BEND_X is a log2(e) / 2.
        a, e = (2.0 * math.log(2.0) * frame.splats[:, column] for column in (layout.BEND_X, layout.BEND_Y))
        x = a * totals[layout.SUM_VU]
        y = e * totals[layout.SUM_VY] - frame.splats[:, layout.SKEW] * x
        return torch.where(seen[:, None], torch.stack([x, y], dim=1), 0.0).float()

    def _project_and_bin(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_count: int,
        background: tuple[float, float, float],
        antialias: bool,
        depth: bool,
    ) -> Frame:
        take, device = self._buffers.take, self._buffers.device
        n, width, height, tiles = gaussians.num, camera.width, camera.height, tiles_of(camera)
        view = projection.view_of(camera, device)
        splats = take("splats", n, layout.SPLAT_COLUMNS)
        depth_keys, self.radii = take("depth_keys", n), take("radii", n)
        tile_counts = take("tile_counts", n, dtype=torch.int32)
        pair_starts = take("pair_starts", n, dtype=torch.int32)
        if n:
            projection.project[(-(-n // PROJECT_BLOCK),)](
                *(value.contiguous() for value in gaussians.tensors().values()),
                view,
                splats,
                depth_keys,
                tile_counts,
                self.radii,
                n,
                width,
                height,
                SH_STORED=gaussians.sh.shape[1],
                SH_COUNT=sh_count,
                ANTIALIAS=antialias,
                BLOCK=PROJECT_BLOCK,
                num_warps=4,
                enable_fp_fusion=False,
            )
        order = torch.sort(depth_keys, stable=True).indices
        pair_ends = tile_counts[order].cumsum(0)
        pairs = int(pair_ends[-1]) if n else 0
        self._require_memory(pairs, tile_counts, camera)
        pair_tiles = take("pair_tiles", pairs, dtype=binning.key_type(tiles))
        pair_owners = take("pair_owners", pairs, dtype=torch.int32)
        pair_ids = take("pair_ids", pairs, dtype=torch.int32)
        pair_slots = take("pair_slots", pairs, dtype=torch.int32)
        if pairs:
            binning.list_pairs[(-(-n // LIST_BLOCK),)](
                splats,
                order,
                tile_counts,
                pair_ends,
                pair_starts,
                pair_tiles,
                pair_owners,
                n,
                width,
                height,
                BLOCK=LIST_BLOCK,
                num_warps=1,
                enable_fp_fusion=False,
            )
        sorted_tiles, sorted_slots = torch.sort(pair_tiles, stable=True)
        if pairs:
            binning.order_pairs[(-(-pairs // ORDER_BLOCK),)](
                sorted_slots, pair_owners, pair_ids, pair_slots, pairs, BLOCK=ORDER_BLOCK, num_warps=4
            )
        tile_starts = binning.tile_starts(sorted_tiles, tiles)
        planes = device_layout.CHUNK_PLANES + depth
        # The number of chunks is known on the device alone; this many there can be at most.
        chunks = pairs // device_layout.CHUNK + min(tiles, pairs)
        return Frame(
            gaussians=gaussians,
            camera=camera,
            view=view,
            background=torch.tensor(background, dtype=torch.float32).to(device, non_blocking=True),
            sh_count=sh_count,
            antialias=antialias,
            planes=planes,
            splats=splats,
            tile_counts=tile_counts,
            pair_starts=pair_starts,
            pair_ids=pair_ids,
            pair_slots=pair_slots,
            tile_starts=tile_starts,
            chunk_starts=binning.chunk_starts(tile_starts),
            chunk_tiles=take("chunk_tiles", chunks, dtype=torch.int32),
            chunk_planes=take("chunk_planes", chunks, planes, layout.TILE_PIXELS),
            deepest=take("deepest", tiles, dtype=torch.int32),
            transmittance=take("transmittance", height, width),
            last=take("last", height, width, dtype=torch.int32),
        )

    def _require_memory(self, pairs: int, tile_counts: Tensor, camera: Camera) -> None:
        """Raise StageError when this many pairs cannot be numbered, or their buffers would not fit."""
        missing = pairs * (PAIR_BYTES + SORT_BYTES) - self._buffers.held(PAIR_BUFFERS)
        if pairs > layout.MAX_PAIRS:
            excess = f"more than {layout.MAX_PAIRS:.2e}"
        elif missing > UNASKED and missing > available_memory(self._buffers.device):
            excess = f"more than fit: they need another {missing / 1e9:.1f} GB of the device's memory"
        else:
            return
        raise StageError(
            f"{int(tile_counts.count_nonzero())} Gaussians touch {pairs:.2e} (tile, splat) pairs at "
            f"{camera.width}x{camera.height}, {excess}",
            hint="lower the resolution or the number of Gaussians, or check for exploded scales",
        )
