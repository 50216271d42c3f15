"""Compile every GPU kernel without a GPU, and print its registers, stack and shared memory.

    python tests/gpu/compile_kernels.py [COMPUTE_CAPABILITY]     (default 90, a Hopper GPU)

The signatures are those of the launches in ``cleargs.splat.kernels.cuda``. Triton's wheel contains ptxas.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from cleargs.splat.kernels.cuda import (
    binning,
    densify,
    elementwise,
    frame_warp,
    gradients,
    loss,
    projection,
    rasterise,
)

F32, F64, I16, I32, I64, U8 = "*fp32", "*fp64", "*i16", "*i32", "*i64", "*u8"
SCENE = dict.fromkeys(("means", "log_scales", "rotations", "logits", "sh"), F32)
SIZE = {"width": "i32", "height": "i32"}
IMAGE = {"image": F32, "target": F32, "saturated": "fp32", "height": "i32", "length": "i32"}
FIELDS = dict.fromkeys(("offset", "sweep", "radius", "curve"), F32)
PHOTOGRAPH = {"height": "i32", "width": "i32", "margin": "i32"}
GRADIENTS = {f"grad_{name}": F32 for name in SCENE}
UNFUSED = {"enable_fp_fusion": False}


def cases() -> list[tuple[Any, dict[str, str], dict[str, Any], dict[str, Any]]]:
    """Return (kernel, types of its run-time arguments, compile-time arguments, options of the launch)."""
    found: list[tuple[Any, dict[str, str], dict[str, Any], dict[str, Any]]] = [
        (
            binning.list_pairs,
            {
                **{"splats": F32, "order": I64, "tile_counts": I32, "pair_ends": I64, "pair_starts": I32},
                **{"pair_tiles": I16, "pair_owners": I32, "n": "i32", **SIZE},
            },
            {},
            {"num_warps": 1, **UNFUSED},
        ),
        (
            binning.place_pairs,
            {
                **{"sorted_tiles": I16, "sorted_slots": I64},
                **dict.fromkeys(("pair_owners", "pair_ids", "pair_slots", "tile_starts"), I32),
                **dict.fromkeys(("pairs", "tiles", "halvings"), "i32"),
            },
            {},
            {},
        ),
        (
            gradients.total,
            {
                **dict.fromkeys(("tile_counts", "reached", "pair_starts"), I32),
                **{"pair_sums": F32, "totals": F64, "n": "i32"},
            },
            {"COLUMNS": 9},
            {},
        ),
        (
            elementwise.adam,
            {
                **SCENE,
                **{f"{kind}_{name}": F32 for kind in ("grad", "first", "second") for name in SCENE},
                "n": "i32",
                **{f"rate_{name}": "fp32" for name in (*SCENE, "sh_rest")},
                **dict.fromkeys(("beta1", "beta2", "epsilon", "root_correction"), "fp32"),
                **dict.fromkeys(("by_opacity", "by_scale"), "fp32"),
            },
            {"COLUMNS": 48},
            {},
        ),
        (
            densify.add_noise,
            {
                **dict.fromkeys(("means", "log_scales", "rotations", "logits"), F32),
                **{"seed": "i64", "amount": "fp32", "min_opacity": "fp32", "cut": "fp32", "n": "i32"},
            },
            {},
            {},
        ),
        (
            loss.window_maps,
            {"maps": F32, "sums": F32, "partials": F64, "totals": F64, "height": "i32", "length": "i32"},
            {},
            {},
        ),
    ]
    found += [
        (
            frame_warp.displace,
            {**dict.fromkeys(("depth", "alpha", "motion"), F32), **FIELDS, **PHOTOGRAPH},
            {"READ_STEPS": 3, "CURVED": True, "BLOCK": frame_warp.BLOCK},
            {},
        ),
        (
            frame_warp.follow_curve,
            {**dict.fromkeys(("image", "curve", "out", "slope"), F32), "pixels": "i32"},
            {"FROM": 3, "TO": 4, "BLOCK": frame_warp.BLOCK},
            {},
        ),
    ]
    for taps in (2, 4):
        sampled = {**FIELDS, "samples": F32, **PHOTOGRAPH, "count": "i32"}
        constants = {"TAPS": taps, "CURVED": taps == 2, "BLOCK": frame_warp.BLOCK}
        found += [
            (
                frame_warp.gather_light,
                {"image": F32, "light": F32, **sampled, "share": "fp32"},
                constants,
                {},
            ),
            (frame_warp.return_light, {"light": F32, "scale": F32, "sums": I64, **sampled}, constants, {}),
        ]
    for masked in (False, True):
        mask = {"mask": U8 if masked else F32}
        constants = {"HAS_MASK": masked}
        found += [
            (loss.window_rows, {**IMAGE, **mask, "sums": F32}, constants, {}),
            (loss.measure, {**IMAGE, **mask, "sums": F32, "maps": F32, "partials": F64}, constants, {}),
            (
                loss.differentiate,
                {
                    **{**IMAGE, **mask, "sums": F32, "totals": F64, "gradient": F32},
                    **{"l1_weight": "fp32", "ssim_weight": "fp32"},
                },
                constants,
                {},
            ),
        ]
    for extra in (False, True):  # depth and anti-aliasing
        frame = {"tile_starts": I32, "chunk_planes": F32, "deepest": I32, **SIZE}
        planes = {"PLANES": 4 + extra}
        background = dict.fromkeys(("back_red", "back_green", "back_blue"), "fp32")
        found += [
            (
                projection.project,
                {
                    **{
                        **SCENE,
                        "view": F64,
                        "poses": F64,
                        "splats": F32,
                        "depth_keys": F32,
                        "tile_counts": I32,
                        "reached": I32,
                        "radii": F32,
                    },
                    **{"n": "i32", **SIZE},
                },
                {"SH_STORED": 16, "SH_COUNT": 16, "ANTIALIAS": extra, "ROLLS": extra},
                UNFUSED,
            ),
            (
                rasterise.forward,
                {
                    **{**frame, **background},
                    **dict.fromkeys(("pair_ids", "chunk_tiles", "last", "reached"), I32),
                    **dict.fromkeys(("splats", "image", "alpha", "transmittance", "depth"), F32),
                },
                {"WITH_DEPTH": extra, **planes},
                {"num_warps": 2},
            ),
            (
                rasterise.behind,
                {
                    **{**frame, **background},
                    **dict.fromkeys(("transmittance", "grad_image", "grad_alpha", "grad_depth"), F32),
                    "chunk_behind": F32,
                },
                {"HAS_ALPHA": extra, "HAS_DEPTH": extra, **planes},
                {},
            ),
            (
                rasterise.backward,
                {
                    **{**frame, "chunk_tiles": I32, "pair_ids": I32, "pair_slots": I32, "last": I32},
                    **dict.fromkeys(("chunk_behind", "splats", "grad_image", "grad_depth", "pair_sums"), F32),
                    "reached": I32,
                },
                {"HAS_DEPTH": extra, **planes, "COLUMNS": 9 + extra},
                {"num_warps": 1},
            ),
            (
                gradients.backpropagate,
                {
                    **{**SCENE, "view": F64, "poses": F64, "splats": F32, "reached": I32, "totals": F64},
                    **{**GRADIENTS, "n": "i32"},
                },
                {"SH_STORED": 16, "SH_COUNT": 16, "ANTIALIAS": extra, "HAS_DEPTH": extra, "ROLLS": extra},
                {},
            ),
        ]
    return found


def compiled(
    kernel: Any, types: dict[str, str], constants: dict[str, Any], options: dict[str, Any], capability: int
) -> Any:
    """Return the compiled kernel. torch's memory is aligned to 16 bytes, which the launcher detects."""
    names = [parameter.name for parameter in kernel.params]
    assert set(names) == {*types, *constants}, kernel.__name__
    source = ASTSource(
        fn=kernel,
        signature={name: types.get(name, "constexpr") for name in names},
        constexprs={(names.index(name),): value for name, value in constants.items()},
        attrs={
            (names.index(name),): [["tt.divisibility", 16]]
            for name, kind in types.items()
            if kind.startswith("*")
        },
    )
    return triton.compile(source, target=GPUTarget("cuda", capability, 32), options=options)


def resources(cubin: bytes) -> tuple[int, int]:
    """Return registers and stack bytes (spilled registers) per thread."""
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        listing = subprocess.run([tool, "-res-usage", file.name], capture_output=True, text=True, check=True)
    found = re.search(r"REG:(\d+) STACK:(\d+)", listing.stdout)
    assert found is not None, listing.stdout
    return int(found[1]), int(found[2])


def main() -> None:
    capability = int(sys.argv[1]) if len(sys.argv) > 1 else 90
    print(f"triton {triton.__version__}, sm_{capability}")
    print("| kernel | registers | stack bytes | shared bytes |", "|---|---|---|---|", sep="\n")
    for kernel, types, constants, options in cases():
        result = compiled(kernel, types, constants, {"num_warps": 4, **options}, capability)
        registers, stack = resources(result.asm["cubin"])
        flags = "".join(f" {name.lower()}" for name, value in constants.items() if value is True)
        shared = result.metadata.shared
        print(f"| {kernel.__name__}{flags} | {registers} | {stack} | {shared} |", flush=True)


if __name__ == "__main__":
    main()
