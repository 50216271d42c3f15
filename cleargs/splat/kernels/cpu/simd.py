"""Eight float32 lanes as an explicit Numba type.

LLVM does not vectorise the rasteriser's loops by itself (too many possible aliases, trip counts of
eight), which costs a factor of three. ``f32x8`` is an LLVM vector: one AVX register, two of SSE or
NEON, half of AVX-512; LLVM picks. ``mask8`` is the result of a comparison.

Arithmetic (+ - * /) and comparisons (< <= > >=) work between ``f32x8`` values and with float32 scalars
on either side. Loads and stores take an array and an element offset and check no bounds.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing import templates
from numba.extending import intrinsic as numba_intrinsic
from numba.extending import lower_builtin, models, register_model
from numba.np import arrayobj

LANES = 8

# Numba's functions for extensions are not annotated.
_signature: Any = templates.signature
_infer_global: Any = templates.infer_global
_register_model: Any = register_model
_lower_builtin: Any = lower_builtin
_make_array: Any = arrayobj.make_array
_initialise_storage: Any = models.PrimitiveModel.__init__
_declare: Any = cgutils.get_or_insert_function

# As in jit.FAST: no nnan, no ninf.
_FLAGS = ("contract", "nsz", "arcp", "reassoc")
# min and max of numbers that the caller knows not to be NaN.
_NO_NAN = ("nnan", "nsz")

_I1, _I32, _I64 = ir.IntType(1), ir.IntType(32), ir.IntType(64)
_BITS = ir.IntType(LANES)
_F32 = ir.FloatType()
_VECTOR = ir.VectorType(_F32, LANES)
_INT_VECTOR = ir.VectorType(_I32, LANES)
_MASK = ir.VectorType(_I1, LANES)
_UNDEFINED = ir.Constant(_VECTOR, ir.Undefined)


class _VectorType(types.Type):
    """The type of eight float32 lanes."""


class _MaskType(types.Type):
    """The type of eight comparison results."""


f32x8 = _VectorType("f32x8")
mask8 = _MaskType("mask8")


def _register_storage(numba_type: type, llvm_type: ir.Type) -> None:
    class Model(models.PrimitiveModel):
        def __init__(self, manager: Any, front_end_type: Any) -> None:
            _initialise_storage(self, manager, front_end_type, llvm_type)

    _register_model(numba_type)(Model)


_register_storage(_VectorType, _VECTOR)
_register_storage(_MaskType, _MASK)


def _broadcast(builder: Any, scalar: Any) -> Any:
    first = builder.insert_element(_UNDEFINED, scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, _UNDEFINED, ir.Constant(_INT_VECTOR, [0] * LANES))


def _register_operator(
    function: Callable[..., Any], cases: list[Any], emit: Callable[[Any, Any, Any], Any]
) -> None:
    _infer_global(function)(type("SimdOperator", (templates.ConcreteTemplate,), {"cases": cases}))
    for case in cases:

        def lower(context: Any, builder: Any, case: Any, values: Any) -> Any:
            wide = [
                value if numba_type != types.float32 else _broadcast(builder, value)
                for value, numba_type in zip(values, case.args, strict=True)
            ]
            return emit(builder, *wide)

        _lower_builtin(function, *case.args)(lower)


def _register_operators() -> None:
    pairs = [(f32x8, f32x8), (f32x8, types.float32), (types.float32, f32x8)]
    arithmetic = {
        operator.add: "fadd",
        operator.sub: "fsub",
        operator.mul: "fmul",
        operator.truediv: "fdiv",
    }
    for function, name in arithmetic.items():

        def calculate(builder: Any, x: Any, y: Any, name: str = name) -> Any:
            return getattr(builder, name)(x, y, flags=_FLAGS)

        _register_operator(function, [_signature(f32x8, *pair) for pair in pairs], calculate)

    comparisons = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">="}
    for function, symbol in comparisons.items():

        def compare(builder: Any, x: Any, y: Any, symbol: str = symbol) -> Any:
            return builder.fcmp_ordered(symbol, x, y)

        _register_operator(function, [_signature(mask8, *pair) for pair in pairs], compare)


_register_operators()


def _intrinsic(function: Callable[..., Any]) -> Callable[..., Any]:
    compiled: Callable[..., Any] = numba_intrinsic(function)
    return compiled


def _address(context: Any, builder: Any, array_type: Any, array: Any, index_type: Any, index: Any) -> Any:
    offset = context.cast(builder, index, index_type, types.intp)
    data = _make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [offset]), _VECTOR.as_pointer())


@_intrinsic
def load8(typing_context: Any, array: Any, offset: Any) -> Any:
    """Eight consecutive elements of a float32 array from ``offset`` (in elements of the whole array)."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = builder.load(_address(context, builder, sig.args[0], args[0], sig.args[1], args[1]))
        value.align = 4
        return value

    return f32x8(array, offset), generate


@_intrinsic
def store8(typing_context: Any, array: Any, offset: Any, value: Any) -> Any:
    """Write eight lanes to consecutive elements of a float32 array."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = _address(context, builder, sig.args[0], args[0], sig.args[1], args[1])
        builder.store(args[2], address).align = 4
        return context.get_dummy_value()

    return types.void(array, offset, value), generate


@_intrinsic
def broadcast8(typing_context: Any, scalar: Any) -> Any:
    """The same float32 in every lane."""
    return f32x8(types.float32), lambda context, builder, sig, args: _broadcast(builder, args[0])


@_intrinsic
def lane_numbers(typing_context: Any) -> Any:
    """0.0, 1.0, ... 7.0."""
    numbers = ir.Constant(_VECTOR, [float(lane) for lane in range(LANES)])
    return f32x8(), lambda context, builder, sig, args: numbers


@_intrinsic
def select8(typing_context: Any, mask: Any, yes: Any, no: Any) -> Any:
    """Lane by lane ``yes`` where the mask is set, else ``no``."""
    return f32x8(mask8, f32x8, f32x8), lambda context, builder, sig, args: builder.select(*args)


def _call(name: str, n: int, flags: tuple[str, ...]) -> Callable[..., Any]:
    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        function_type = ir.FunctionType(_VECTOR, [_VECTOR] * n)
        function = _declare(builder.module, function_type, name)
        return builder.call(function, args, fastmath=flags)

    return generate


# min and max call LLVM's functions because select(x < y, load p, y) followed by a store to p turns into
# a masked store (vmaskmov), which is microcoded on AMD: it nearly doubled the forward pass.
@_intrinsic
def min8(typing_context: Any, x: Any, y: Any) -> Any:
    """Lane-wise minimum; neither side may be NaN."""
    return f32x8(f32x8, f32x8), _call("llvm.minnum.v8f32", 2, _NO_NAN)


@_intrinsic
def max8(typing_context: Any, x: Any, y: Any) -> Any:
    """Lane-wise maximum; neither side may be NaN."""
    return f32x8(f32x8, f32x8), _call("llvm.maxnum.v8f32", 2, _NO_NAN)


@_intrinsic
def abs8(typing_context: Any, x: Any) -> Any:
    """|x|."""
    return f32x8(f32x8), _call("llvm.fabs.v8f32", 1, ())


@_intrinsic
def sqrt8(typing_context: Any, x: Any) -> Any:
    """Correctly rounded square root."""
    return f32x8(f32x8), _call("llvm.sqrt.v8f32", 1, ())


@_intrinsic
def negative_magnitude8(typing_context: Any, x: Any) -> Any:
    """-|x| by setting the sign bit."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], _INT_VECTOR)
        return builder.bitcast(builder.or_(bits, ir.Constant(_INT_VECTOR, [-(2**31)] * LANES)), _VECTOR)

    return f32x8(f32x8), generate


@_intrinsic
def any8(typing_context: Any, mask: Any) -> Any:
    """True when a lane is set."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], _BITS), ir.Constant(_BITS, 0))

    return types.boolean(mask8), generate


@_intrinsic
def mask_bits(typing_context: Any, mask: Any) -> Any:
    """The mask as an int64, lane 0 in bit 0."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], _BITS), _I64)

    return types.int64(mask8), generate


@_intrinsic
def lowest_bit(typing_context: Any, bits: Any) -> Any:
    """Position of the lowest set bit of a non-zero int64."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(_I1, 1))

    return types.int64(types.int64), generate


@_intrinsic
def lane_sum(typing_context: Any, x: Any) -> Any:
    """Sum of the eight lanes."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        function_type = ir.FunctionType(_F32, [_F32, _VECTOR])
        function = _declare(builder.module, function_type, "llvm.vector.reduce.fadd.v8f32")
        return builder.call(function, [ir.Constant(_F32, 0.0), args[0]], fastmath=_FLAGS)

    return types.float32(f32x8), generate


def _add_shuffled(builder: Any, x: Any, y: Any, left: list[int], right: list[int]) -> Any:
    def pick(lanes: list[int]) -> Any:
        return builder.shuffle_vector(x, y, ir.Constant(_INT_VECTOR, lanes))

    return builder.fadd(pick(left), pick(right), flags=_FLAGS)


@_intrinsic
def lane_sums(typing_context: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any) -> Any:
    """The lane sums of eight vectors as one vector: a transposition with additions in three steps."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rows = list(args)
        pairs = ([0, 8, 2, 10, 4, 12, 6, 14], [1, 9, 3, 11, 5, 13, 7, 15])
        quads = ([0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15])
        halves = ([0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15])
        for left, right in (pairs, quads, halves):
            rows = [_add_shuffled(builder, rows[i], rows[i + 1], left, right) for i in range(0, len(rows), 2)]
        return rows[0]

    return f32x8(*[f32x8] * 8), generate
