"""A pixel's four float32 numbers (RGB and one of padding) as one SIMD value, beside `simd`'s lanes.

Where every pixel reads from another place, lanes would have to be gathered; the channels of a pixel lie side
by side. Images are [H, W, 4]; offsets count elements of the whole array and are not checked.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types

from cleargs.splat.kernels.cpu.simd import (
    _FLAGS,
    _broadcast_to,
    _element_address,
    _intrinsic,
    _register_type,
)
from cleargs.splat.kernels.warp_layout import CHANNELS

_VECTOR = ir.VectorType(ir.FloatType(), CHANNELS)


class _PixelType(types.Type):
    """The type of four float32 numbers."""


pixel = _PixelType("pixel")
_register_type(_PixelType, _VECTOR)


def _at(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    address = _element_address(context, builder, sig.args[0], args[0], sig.args[1], args[1])
    return builder.bitcast(address, _VECTOR.as_pointer())


def _loaded(builder: Any, address: Any) -> Any:
    value = builder.load(address)
    value.align = 4
    return value


def _scaled(builder: Any, value: Any, factor: Any) -> Any:
    return builder.fmul(value, _broadcast_to(builder, factor, _VECTOR), flags=_FLAGS)


@_intrinsic
def black(typing_context: Any) -> Any:
    """Zeros."""
    return pixel(), lambda context, builder, sig, args: ir.Constant(_VECTOR, [0.0] * CHANNELS)


@_intrinsic
def load_pixel(typing_context: Any, array: Any, offset: Any) -> Any:
    """The pixel at ``offset``."""
    return pixel(array, offset), lambda context, builder, sig, args: _loaded(
        builder, _at(context, builder, sig, args)
    )


@_intrinsic
def store_pixel(typing_context: Any, array: Any, offset: Any, value: Any) -> Any:
    """Write the pixel at ``offset``."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _at(context, builder, sig, args)).align = 4
        return context.get_dummy_value()

    return types.void(array, offset, pixel), generate


@_intrinsic
def scaled(typing_context: Any, value: Any, factor: Any) -> Any:
    """``value * factor`` for a float32 ``factor``."""
    return pixel(pixel, types.float32), lambda context, builder, sig, args: _scaled(builder, *args)


@_intrinsic
def plus_scaled(typing_context: Any, total: Any, value: Any, factor: Any) -> Any:
    """``total + value * factor`` for a float32 ``factor``."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.fadd(args[0], _scaled(builder, args[1], args[2]), flags=_FLAGS)

    return pixel(pixel, pixel, types.float32), generate
