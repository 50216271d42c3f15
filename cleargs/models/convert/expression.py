"""A network as an immutable expression: ONNX operators on tensors of known shape.

Every expression is built by a function of this module, which computes its shape and evaluates it at once
where all inputs are constants. A graph is one such expression; shared parts are shared objects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Shape: TypeAlias = tuple[int, ...]
Attribute: TypeAlias = int | float | str | tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Expression:
    """An operator applied to inputs. Two expressions are equal only if they are the same object.

    op: the ONNX operator, or ``Input`` or ``Constant``; value: that of a constant.
    """

    op: str
    inputs: tuple[Expression, ...]
    attributes: Mapping[str, Attribute]
    shape: Shape
    value: NDArray[Any] | None = field(default=None, repr=False)

    @property
    def is_constant(self) -> bool:
        """Whether the value is known."""
        return self.value is not None

    @property
    def rank(self) -> int:
        """Number of axes."""
        return len(self.shape)


_NONE: Mapping[str, Attribute] = MappingProxyType({})

_ELEMENTWISE: Mapping[str, Callable[..., Any]] = MappingProxyType(
    {
        "Add": np.add,
        "Sub": np.subtract,
        "Mul": np.multiply,
        "Div": np.divide,
        "Max": np.maximum,
        "Min": np.minimum,
        "GreaterOrEqual": np.greater_equal,
        "Where": np.where,
        "Abs": np.abs,
        "Neg": np.negative,
        "Exp": np.exp,
        "Tanh": np.tanh,
        "Sqrt": np.sqrt,
        "Reciprocal": np.reciprocal,
    }
)


def source(shape: Shape) -> Expression:
    """The network's input."""
    return Expression("Input", (), _NONE, shape)


def constant(value: Any) -> Expression:
    """A known tensor."""
    array = np.asarray(value)
    return Expression("Constant", (), _NONE, array.shape, array)


def elementwise(op: str, *inputs: Expression) -> Expression:
    """An operator that broadcasts, such as ``Add`` or ``Where``."""
    values = [x.value for x in inputs]
    if all(value is not None for value in values):
        return constant(_ELEMENTWISE[op](*values))
    return Expression(op, inputs, _NONE, np.broadcast_shapes(*(x.shape for x in inputs)))


def reshape(x: Expression, shape: Shape) -> Expression:
    """The same elements in another shape (all extents given)."""
    while x.op == "Reshape":
        x = x.inputs[0]
    if x.shape == shape:
        return x
    if x.value is not None:
        return constant(x.value.reshape(shape))
    if math.prod(x.shape) != math.prod(shape):
        raise ValueError(f"{x.shape} cannot be reshaped to {shape}")
    return Expression("Reshape", (x, constant(np.array(shape, np.int64))), _NONE, shape)


def transpose(x: Expression, axes: Shape) -> Expression:
    """Axes in another order; two transpositions in a row become one."""
    if x.op == "Transpose":
        inner = x.attributes["perm"]
        assert isinstance(inner, tuple)
        x, axes = x.inputs[0], tuple(inner[axis] for axis in axes)
    if axes == tuple(range(x.rank)):
        return x
    if x.value is not None:
        return constant(np.ascontiguousarray(x.value.transpose(axes)))
    return Expression("Transpose", (x,), {"perm": axes}, tuple(x.shape[axis] for axis in axes))


def expand(x: Expression, shape: Shape) -> Expression:
    """Broadcast to ``shape``."""
    if x.shape == shape:
        return x
    if x.value is not None:
        return constant(np.broadcast_to(x.value, shape))
    return Expression("Expand", (x, constant(np.array(shape, np.int64))), _NONE, shape)


def reduce_sum(x: Expression, axes: Shape) -> Expression:
    """The sum over some axes, which remain with extent 1."""
    shape = tuple(1 if axis in axes else extent for axis, extent in enumerate(x.shape))
    if x.value is not None:
        return constant(x.value.sum(axis=axes, keepdims=True))
    return Expression("ReduceSum", (x, constant(np.array(axes, np.int64))), {"keepdims": 1}, shape)


def concat(inputs: tuple[Expression, ...], axis: int) -> Expression:
    """Inputs joined along an axis (not negative)."""
    values = [x.value for x in inputs if x.value is not None]
    if len(values) == len(inputs):
        return constant(np.concatenate(values, axis))
    shape = list(inputs[0].shape)
    shape[axis] = sum(x.shape[axis] for x in inputs)
    return Expression("Concat", inputs, {"axis": axis}, tuple(shape))


def crop(x: Expression, starts: Shape, sizes: Shape) -> Expression:
    """A box cut out of ``x``."""
    axes = tuple(axis for axis in range(x.rank) if (starts[axis], sizes[axis]) != (0, x.shape[axis]))
    if not axes:
        return x
    if x.value is not None:
        return constant(x.value[tuple(slice(a, a + n) for a, n in zip(starts, sizes, strict=True))])
    bounds = ([starts[a] for a in axes], [starts[a] + sizes[a] for a in axes], axes)
    return Expression("Slice", (x, *(constant(np.array(b, np.int64)) for b in bounds)), _NONE, sizes)


def gather(x: Expression, indices: Expression, axis: int) -> Expression:
    """The given slices of ``x`` along an axis (not negative)."""
    shape = x.shape[:axis] + indices.shape + x.shape[axis + 1 :]
    if x.value is not None and indices.value is not None:
        return constant(np.take(x.value, indices.value, axis))
    return Expression("Gather", (x, indices), {"axis": axis}, shape)


def matmul(a: Expression, b: Expression) -> Expression:
    """The matrix product over the last two axes, those before broadcast."""
    batch = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    if a.shape[-1] != b.shape[-2]:
        raise ValueError(f"{a.shape} cannot be multiplied with {b.shape}")
    return Expression("MatMul", (a, b), _NONE, (*batch, a.shape[-2], b.shape[-1]))


def convolution(
    x: Expression,  # [N, C, H, W]
    kernel: Expression,  # [D, C, h, w]
    strides: Shape,
    pads: Shape,  # top, left, bottom, right
) -> Expression:
    """A convolution without bias."""
    spatial = (
        (x.shape[2 + k] + pads[k] + pads[2 + k] - kernel.shape[2 + k]) // strides[k] + 1 for k in range(2)
    )
    attributes = {"kernel_shape": kernel.shape[2:], "strides": strides, "pads": pads}
    return Expression("Conv", (x, kernel), attributes, (x.shape[0], kernel.shape[0], *spatial))


def transposed_convolution(
    x: Expression,  # [N, C, H, W]
    kernel: Expression,  # [C, D, h, w]
    strides: Shape,
) -> Expression:
    """The transpose of an unpadded strided convolution, without bias."""
    spatial = ((x.shape[2 + k] - 1) * strides[k] + kernel.shape[2 + k] for k in range(2))
    attributes = {"kernel_shape": kernel.shape[2:], "strides": strides}
    return Expression("ConvTranspose", (x, kernel), attributes, (x.shape[0], kernel.shape[1], *spatial))
