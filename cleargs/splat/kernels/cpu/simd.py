"""SIMD vectors of float32 lanes as a Numba type: sixteen lanes on AVX-512, else eight.

LLVM does not vectorise the rasteriser's loops by itself (too many possible aliases, short trip counts), which
would cost a factor of three. ``lanes`` is an LLVM vector: one register of AVX or AVX-512, two of SSE or NEON.
``mask`` is the result of a comparison. Sixteen lanes are one row of a tile; without AVX-512 they would need
two registers, also for splats that touch one half.

Arithmetic (+ - * /) and comparisons (< <= > >=) work between ``lanes`` values, and with float32 scalars on
either side. Loads and stores take an array and an element offset; bounds are not checked.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import wraps
from typing import Any

from llvmlite import binding, ir
from numba import config
from numba.core import cgutils, types
from numba.core.typing import templates
from numba.extending import intrinsic as numba_intrinsic
from numba.extending import lower_builtin, models, register_model
from numba.np import arrayobj


def _register_lanes() -> int:
    """Return the number of float32 lanes of a vector on the machine that Numba compiles for."""
    settings: Any = config
    if settings.CPU_NAME is None:
        return 16 if binding.get_host_cpu_features().get("avx512f", False) else 8
    return 16 if "+avx512f" in (settings.CPU_FEATURES or "") else 8


LANES = _register_lanes()
SUMS = 8
"""Number of vectors whose lane sums `store_lane_sums` writes."""

# Numba's functions for extensions have no type annotations.
_signature: Any = templates.signature
_infer_global: Any = templates.infer_global
_register_model: Any = register_model
_lower_builtin: Any = lower_builtin
_make_array: Any = arrayobj.make_array
_initialise_storage: Any = models.PrimitiveModel.__init__
_declare: Any = cgutils.get_or_insert_function

# The flags of jit.FAST.
FLAGS = ("contract", "nsz", "arcp")
# For minimum and maximum, whose arguments are never NaN.
_NO_NAN = ("nnan", "nsz")

_I1, _I32, _I64 = ir.IntType(1), ir.IntType(32), ir.IntType(64)
_BITS = ir.IntType(LANES)
_BYTES = ir.IntType(8).as_pointer()
_F32 = ir.FloatType()
_VECTOR = ir.VectorType(_F32, LANES)
_INT_VECTOR = ir.VectorType(_I32, LANES)
_MASK = ir.VectorType(_I1, LANES)


class _VectorType(types.Type):
    """Numba type of LANES float32 lanes."""


class _MaskType(types.Type):
    """Numba type of LANES comparison results."""


lanes = _VectorType(f"f32x{LANES}")
mask = _MaskType(f"mask{LANES}")


def register_type(numba_type: type, llvm_type: ir.Type) -> None:
    """Define how Numba stores values of a type."""

    class Model(models.PrimitiveModel):
        def __init__(self, manager: Any, front_end_type: Any) -> None:
            _initialise_storage(self, manager, front_end_type, llvm_type)

    _register_model(numba_type)(Model)


register_type(_VectorType, _VECTOR)
register_type(_MaskType, _MASK)


def broadcast_to(builder: Any, scalar: Any, vector: Any) -> Any:
    """Return a value of the LLVM type ``vector`` with ``scalar`` in every lane."""
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
    zeros = ir.Constant(ir.VectorType(_I32, vector.count), [0] * vector.count)
    return builder.shuffle_vector(first, undefined, zeros)


def _register_operator(
    function: Callable[..., Any], cases: list[Any], emit: Callable[[Any, Any, Any], Any]
) -> None:
    _infer_global(function)(type("SimdOperator", (templates.ConcreteTemplate,), {"cases": cases}))
    for case in cases:

        def lower(context: Any, builder: Any, case: Any, values: Any) -> Any:
            vector = next(x.type for x in values if isinstance(x.type, ir.VectorType))
            wide = (x if x.type == vector else broadcast_to(builder, x, vector) for x in values)
            return emit(builder, *wide)

        _lower_builtin(function, *case.args)(lower)


def register_arithmetic(kind: Any) -> None:
    """Define + - * / between values of ``kind``, and with float32 scalars on either side."""
    pairs = [(kind, kind), (kind, types.float32), (types.float32, kind)]
    operators = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
    for function, name in operators.items():

        def calculate(builder: Any, x: Any, y: Any, name: str = name) -> Any:
            return getattr(builder, name)(x, y, flags=FLAGS)

        _register_operator(function, [_signature(kind, *pair) for pair in pairs], calculate)


def _register_comparisons() -> None:
    pairs = [(lanes, lanes), (lanes, types.float32), (types.float32, lanes)]
    comparisons = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">="}
    for function, symbol in comparisons.items():

        def compare(builder: Any, x: Any, y: Any, symbol: str = symbol) -> Any:
            return builder.fcmp_ordered(symbol, x, y)

        _register_operator(function, [_signature(mask, *pair) for pair in pairs], compare)


register_arithmetic(lanes)
_register_comparisons()


def typed_intrinsic(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``numba.extending.intrinsic`` of a function, with a declared type."""
    return numba_intrinsic(function)


def operation(result: Any, *kinds: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator for a function that emits the code of an intrinsic for values of these kinds."""

    def decorate(emit: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(emit)  # so that Numba sees the names of the arguments
        def typed(typing_context: Any, *values: Any) -> Any:
            return result(*kinds), lambda context, builder, sig, args: emit(builder, *args)

        return typed_intrinsic(typed)

    return decorate


def _address(context: Any, builder: Any, sig: Any, args: Any, to: Any = _VECTOR) -> Any:
    """Return the address of element ``args[1]`` of the array ``args[0]``, as a pointer to the type ``to``."""
    offset = context.cast(builder, args[1], sig.args[1], types.intp)
    data = _make_array(sig.args[0])(context, builder, args[0]).data
    return builder.bitcast(builder.gep(data, [offset]), to.as_pointer())


def loading(vector: Any) -> Callable[..., Any]:
    """Return the code generator that loads the LLVM type ``vector`` from an array at an element offset."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = builder.load(_address(context, builder, sig, args, vector))
        value.align = 4
        return value

    return generate


@typed_intrinsic
def load(typing_context: Any, array: Any, offset: Any) -> Any:
    """Load LANES consecutive elements of a float32 array from ``offset`` (in elements of the whole array)."""
    return lanes(array, offset), loading(_VECTOR)


@typed_intrinsic
def store(typing_context: Any, array: Any, offset: Any, value: Any) -> Any:
    """Write lanes, a pixel or a pair of pixels to consecutive elements of a float32 array."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _address(context, builder, sig, args, args[2].type)).align = 4
        return context.get_dummy_value()

    return types.void(array, offset, value), generate


def _prefetch(write: int) -> Callable[..., Any]:
    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = builder.bitcast(_address(context, builder, sig, args), _BYTES)
        function_type = ir.FunctionType(ir.VoidType(), [_BYTES, _I32, _I32, _I32])
        function = _declare(builder.module, function_type, "llvm.prefetch.p0")
        keep, data = ir.Constant(_I32, 3), ir.Constant(_I32, 1)
        builder.call(function, [address, ir.Constant(_I32, write), keep, data])
        return context.get_dummy_value()

    return generate


@typed_intrinsic
def prefetch(typing_context: Any, array: Any, offset: Any) -> Any:
    """Prefetch the cache line of an element that will be read."""
    return types.void(array, offset), _prefetch(0)


@typed_intrinsic
def prefetch_to_write(typing_context: Any, array: Any, offset: Any) -> Any:
    """Prefetch the cache line of an element that will be written."""
    return types.void(array, offset), _prefetch(1)


@operation(lanes, types.float32)
def broadcast(builder: Any, scalar: Any) -> Any:
    """Return a vector with the same float32 in every lane."""
    return broadcast_to(builder, scalar, _VECTOR)


@operation(lanes)
def lane_numbers(builder: Any) -> Any:
    """Return the lanes 0.0, 1.0, ... LANES - 1."""
    return ir.Constant(_VECTOR, [float(lane) for lane in range(LANES)])


@operation(lanes, mask, lanes, lanes)
def select(builder: Any, where: Any, yes: Any, no: Any) -> Any:
    """Return ``yes`` in lanes where the mask is set, and ``no`` in the others."""
    return builder.select(where, yes, no)


def _call(builder: Any, name: str, *args: Any, flags: tuple[str, ...] = ()) -> Any:
    function_type = ir.FunctionType(_VECTOR, [_VECTOR] * len(args))
    function = _declare(builder.module, function_type, f"llvm.{name}.v{LANES}f32")
    return builder.call(function, args, fastmath=flags)


# minimum and maximum call LLVM's functions because select(x < y, load p, y) followed by a store to p turns
# into a masked store (vmaskmov). It is microcoded on AMD and nearly doubled the time of the forward pass.
@operation(lanes, lanes, lanes)
def minimum(builder: Any, x: Any, y: Any) -> Any:
    """Return the lane-wise minimum; neither side may be NaN."""
    return _call(builder, "minnum", x, y, flags=_NO_NAN)


@operation(lanes, lanes, lanes)
def maximum(builder: Any, x: Any, y: Any) -> Any:
    """Return the lane-wise maximum; neither side may be NaN."""
    return _call(builder, "maxnum", x, y, flags=_NO_NAN)


@operation(lanes, lanes)
def magnitude(builder: Any, x: Any) -> Any:
    """Return |x|."""
    return _call(builder, "fabs", x)


@operation(lanes, lanes)
def negative_magnitude(builder: Any, x: Any) -> Any:
    """Return -|x| by setting the sign bit."""
    bits = builder.bitcast(x, _INT_VECTOR)
    return builder.bitcast(builder.or_(bits, ir.Constant(_INT_VECTOR, [-(2**31)] * LANES)), _VECTOR)


@operation(types.boolean, mask)
def any_lane(builder: Any, where: Any) -> Any:
    """Return True if any lane is set."""
    return builder.icmp_unsigned("!=", builder.bitcast(where, _BITS), ir.Constant(_BITS, 0))


@operation(types.int64, mask)
def mask_bits(builder: Any, where: Any) -> Any:
    """Return the mask as an int64, lane 0 in bit 0."""
    return builder.zext(builder.bitcast(where, _BITS), _I64)


@operation(types.int64, types.int64)
def lowest_bit(builder: Any, bits: Any) -> Any:
    """Return the position of the lowest set bit of a non-zero int64."""
    return builder.cttz(bits, ir.Constant(_I1, 1))


@operation(types.float32, lanes)
def lane_sum(builder: Any, x: Any) -> Any:
    """Return the sum of all lanes."""
    function_type = ir.FunctionType(_F32, [_F32, _VECTOR])
    function = _declare(builder.module, function_type, f"llvm.vector.reduce.fadd.v{LANES}f32")
    # Without reassoc the lanes would be added one by one. No code around this call can change their order.
    return builder.call(function, [ir.Constant(_F32, 0.0), x], fastmath=(*FLAGS, "reassoc"))


def _add_picked(builder: Any, x: Any, y: Any, left: list[int], right: list[int]) -> Any:
    """Join x and y to one vector, and add its lanes ``right`` to its lanes ``left``."""

    def pick(numbers: list[int]) -> Any:
        kind = ir.VectorType(_I32, len(numbers))
        return builder.shuffle_vector(x, y, ir.Constant(kind, numbers))

    return builder.fadd(pick(left), pick(right), flags=FLAGS)


@typed_intrinsic
def store_lane_sums(
    typing_context: Any,
    array: Any,
    offset: Any,
    a: Any,
    b: Any,
    c: Any,
    d: Any,
    e: Any,
    f: Any,
    g: Any,
    h: Any,
) -> Any:
    """Write the lane sums of eight vectors to consecutive elements of a float32 array.

    Each step combines pairs of vectors: in each vector, one half of its lanes is added to the other half.
    After three steps, a single vector holds the partial sums of all eight, each in an eighth of its lanes.
    """

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rows, block = list(args[2:]), LANES
        while len(rows) > 1:
            blocks = range(0, 2 * LANES, block)
            left = [lane for start in blocks for lane in range(start, start + block // 2)]
            right = [lane + block // 2 for lane in left]
            rows = [
                _add_picked(builder, x, y, left, right) for x, y in zip(rows[::2], rows[1::2], strict=True)
            ]
            block //= 2
        total = rows[0]
        if block == 2:
            total = _add_picked(builder, total, total, list(range(0, LANES, 2)), list(range(1, LANES, 2)))
        address = _address(context, builder, sig, args, ir.VectorType(_F32, SUMS))
        builder.store(total, address).align = 4
        return context.get_dummy_value()

    return types.void(array, offset, *[lanes] * SUMS), generate
