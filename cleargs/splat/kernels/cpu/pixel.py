"""SIMD types for a pixel (four float32 numbers: RGB and one of padding) and for a pair of pixels.

In a warp each pixel reads from another position, so the lanes of `simd` would need slow gather loads. The
channels of a pixel are adjacent in memory, and so are the two pixels of a row around a position. Arithmetic
(+ - * /) works as between lanes. Images are [H, W, 4]. Offsets count elements of the whole array; bounds are
not checked.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types

from cleargs.splat.kernels.cpu.simd import (
    FLAGS,
    broadcast_to,
    loading,
    operation,
    register_arithmetic,
    register_type,
    typed_intrinsic,
)
from cleargs.splat.kernels.warp_layout import CHANNELS

_PIXEL = ir.VectorType(ir.FloatType(), CHANNELS)
_PAIR = ir.VectorType(ir.FloatType(), 2 * CHANNELS)
_I32, _I64 = ir.IntType(32), ir.IntType(64)
_WHOLE = ir.VectorType(_I32, CHANNELS)


class _PixelType(types.Type):
    """Numba type of a pixel."""


class _PairType(types.Type):
    """Numba type of a pixel and its right neighbour."""


pixel = _PixelType("pixel")
pair = _PairType("pixel pair")
register_type(_PixelType, _PIXEL)
register_type(_PairType, _PAIR)
register_arithmetic(pixel)
register_arithmetic(pair)

# Numba's constructor has no type annotations.
_new_tuple: Any = types.UniTuple
_SHARES = _new_tuple(types.float32, 2)


@operation(pixel)
def black(builder: Any) -> Any:
    """Return a pixel of zeros."""
    return ir.Constant(_PIXEL, [0.0] * CHANNELS)


@operation(pair)
def black_pair(builder: Any) -> Any:
    """Return two pixels of zeros."""
    return ir.Constant(_PAIR, [0.0] * 2 * CHANNELS)


@typed_intrinsic
def load_pixel(typing_context: Any, array: Any, offset: Any) -> Any:
    """Load the pixel at ``offset``."""
    return pixel(array, offset), loading(_PIXEL)


@typed_intrinsic
def load_pair(typing_context: Any, array: Any, offset: Any) -> Any:
    """Load the pixel at ``offset`` and its right neighbour."""
    return pair(array, offset), loading(_PAIR)


@operation(pair, types.float32)
def shares(builder: Any, second: Any) -> Any:
    """Return the weights of a pair: 1 - ``second`` for the first pixel, ``second`` for the other."""
    base = ir.Constant(_PAIR, [1.0] * CHANNELS + [0.0] * CHANNELS)
    rise = ir.Constant(_PAIR, [-1.0] * CHANNELS + [1.0] * CHANNELS)
    change = builder.fmul(rise, broadcast_to(builder, second, _PAIR), flags=FLAGS)
    return builder.fadd(base, change, flags=FLAGS)


@operation(pair, pixel)
def both(builder: Any, value: Any) -> Any:
    """Return a pair that holds a pixel twice."""
    places = ir.Constant(ir.VectorType(_I32, 2 * CHANNELS), [*range(CHANNELS)] * 2)
    return builder.shuffle_vector(value, value, places)


@operation(pixel, pair)
def sum_of(builder: Any, value: Any) -> Any:
    """Return the sum of the two pixels of a pair."""
    left, right = (
        builder.shuffle_vector(value, value, ir.Constant(_WHOLE, [*range(start, start + CHANNELS)]))
        for start in (0, CHANNELS)
    )
    return builder.fadd(left, right, flags=FLAGS)


# -- positions in an image: x and y are the first two numbers of a pixel -------------------------------------


@operation(pixel, types.float32, types.float32)
def place_of(builder: Any, x: Any, y: Any) -> Any:
    """Return the position (x, y) in pixels, float32."""
    place = ir.Constant(_PIXEL, [0.0] * CHANNELS)
    for lane, number in enumerate((x, y)):
        place = builder.insert_element(place, number, ir.Constant(_I32, lane))
    return place


@operation(types.int64, pixel, types.int64)
def offset_of(builder: Any, place: Any, columns: Any) -> Any:
    """Return the offset (int64) of the pixel left of and above ``place`` in an image of width ``columns``.

    Positions must not be negative.
    """
    whole = builder.fptosi(place, _WHOLE)
    x, y = (builder.sext(builder.extract_element(whole, ir.Constant(_I32, n)), _I64) for n in (0, 1))
    return builder.mul(builder.add(builder.mul(y, columns), x), ir.Constant(_I64, CHANNELS))


@typed_intrinsic
def fractions_of(typing_context: Any, place: Any) -> Any:
    """Return the distances, two float32, from the pixel of `offset_of` right and down to ``place``."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        whole = builder.sitofp(builder.fptosi(args[0], _WHOLE), _PIXEL)
        rest = builder.fsub(args[0], whole, flags=FLAGS)
        parts = [builder.extract_element(rest, ir.Constant(_I32, n)) for n in (0, 1)]
        return context.make_tuple(builder, sig.return_type, parts)

    return _SHARES(pixel), generate
