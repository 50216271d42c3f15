"""TensorFlow.js graph models, read without TensorFlow.

A graph model is a JSON file with the nodes of a TensorFlow graph and a manifest of binary files with its
constants. With the input's size given, all shape arithmetic in the graph is evaluated here, and what is left
are few kinds of operators.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cleargs.models.convert import expression as ex
from cleargs.models.convert.expression import Expression, Shape

Nodes: TypeAlias = Mapping[str, Mapping[str, Any]]
Weights: TypeAlias = Mapping[str, NDArray[Any]]

NHWC_TO_NCHW = (0, 3, 1, 2)
NCHW_TO_NHWC = (0, 2, 3, 1)


def read_model(read: Callable[[str], bytes], name: str = "model.json") -> tuple[Nodes, Weights]:
    """The nodes, by name, and the constants of a graph model; ``read`` gives the content of its files."""
    model = json.loads(read(name))
    nodes = {node["name"]: node for node in model["modelTopology"]["node"]}
    weights: dict[str, NDArray[Any]] = {}
    for group in model["weightsManifest"]:
        data = b"".join(read(path) for path in group["paths"])
        offset = 0
        for entry in group["weights"]:
            if "quantization" in entry:
                raise ValueError(f"{entry['name']} is quantised, which is not supported")
            dtype = np.dtype({"float32": "<f4", "int32": "<i4", "bool": "?"}[entry["dtype"]])
            count = math.prod(entry["shape"])
            array = np.frombuffer(data, dtype, count, offset).reshape(entry["shape"])
            weights[entry["name"]] = array
            offset += array.nbytes
    return nodes, weights


def translate(nodes: Nodes, weights: Weights, output: str, shape: Shape) -> Expression:
    """The expression that a node computes when the graph's one input has ``shape``.

    Raises ValueError for an operator, or a use of one, that is not known here.
    """
    done: dict[str, Expression] = {}
    stack = [output]
    while stack:
        name = stack[-1]
        if name in done:
            stack.pop()
            continue
        node = nodes[name]
        # "^name" orders side effects, of which there are none here.
        inputs = [i.removesuffix(":0") for i in node.get("input", ()) if not i.startswith("^")]
        missing = [i for i in inputs if i not in done]
        if missing:
            stack.extend(missing)
            continue
        if node["op"] == "Placeholder":
            done[name] = ex.source(shape)
        elif node["op"] == "Const":
            done[name] = ex.constant(weights[name])
        elif node["op"] in _OPERATORS:
            done[name] = _OPERATORS[node["op"]](_Attributes(node), *(done[i] for i in inputs))
        else:
            raise ValueError(f"the operator {node['op']} is not known")
    return done[output]


class _Attributes:
    """The attributes of a node, decoded."""

    def __init__(self, node: Mapping[str, Any]) -> None:
        self._values = node.get("attr", {})

    def text(self, name: str) -> str:
        return base64.b64decode(self._values[name]["s"]).decode()

    def integer(self, name: str, default: int = 0) -> int:
        return int(self._values.get(name, {}).get("i", default))

    def integers(self, name: str) -> Shape:
        return tuple(int(i) for i in self._values[name]["list"].get("i", ()))

    def flag(self, name: str) -> bool:
        return bool(self._values.get(name, {}).get("b", False))

    def dtype(self, name: str) -> np.dtype[Any]:
        names = {"DT_FLOAT": np.float32, "DT_INT32": np.int32, "DT_BOOL": np.bool_}
        return np.dtype(names[self._values[name]["type"]])


_Operator: TypeAlias = Callable[..., Expression]


def _known(x: Expression) -> NDArray[Any]:
    if x.value is None:
        raise ValueError("a shape, an index or a mask depends on the image")
    return x.value


def _ints(x: Expression) -> Shape:
    return tuple(int(i) for i in _known(x).ravel())


def _elementwise(op: str) -> _Operator:
    return lambda _, *inputs: ex.elementwise(op, *inputs)


def _on_constants(function: Callable[..., Any]) -> _Operator:
    """For operators that only occur in the arithmetic of shapes, indices and masks."""
    return lambda _, *inputs: ex.constant(function(*(_known(x) for x in inputs)))


def _greater_equal(_: _Attributes, a: Expression, b: Expression) -> Expression:
    return ex.elementwise("GreaterOrEqual", a, b)


def _square(_: _Attributes, x: Expression) -> Expression:
    return ex.elementwise("Mul", x, x)


def _rsqrt(_: _Attributes, x: Expression) -> Expression:
    return ex.elementwise("Reciprocal", ex.elementwise("Sqrt", x))


def _cast(attributes: _Attributes, x: Expression) -> Expression:
    return ex.constant(_known(x).astype(attributes.dtype("DstT")))


def _pack(attributes: _Attributes, *inputs: Expression) -> Expression:
    return ex.constant(np.stack([_known(x) for x in inputs], attributes.integer("axis")))


def _reshape(_: _Attributes, x: Expression, shape: Expression) -> Expression:
    extents = list(_ints(shape))
    if -1 in extents:
        extents[extents.index(-1)] = math.prod(x.shape) // -math.prod(extents)
    return ex.reshape(x, tuple(extents))


def _transpose(_: _Attributes, x: Expression, axes: Expression) -> Expression:
    return ex.transpose(x, _ints(axes))


def _broadcast_to(_: _Attributes, x: Expression, shape: Expression) -> Expression:
    return ex.expand(x, _ints(shape))


def _sum(attributes: _Attributes, x: Expression, axes: Expression) -> Expression:
    dropped = tuple(sorted(axis % x.rank for axis in _ints(axes)))
    total = ex.reduce_sum(x, dropped)
    if attributes.flag("keep_dims"):
        return total
    return ex.reshape(total, tuple(n for axis, n in enumerate(x.shape) if axis not in dropped))


def _concat(_: _Attributes, *inputs: Expression) -> Expression:
    (axis,) = _ints(inputs[-1])
    return ex.concat(inputs[:-1], axis % inputs[0].rank)


def _strided_slice(
    attributes: _Attributes, x: Expression, begin: Expression, end: Expression, strides: Expression
) -> Expression:
    masks = ("begin_mask", "end_mask", "ellipsis_mask", "new_axis_mask")
    if any(attributes.integer(mask) for mask in masks) or set(_ints(strides)) != {1}:
        raise ValueError("only plain slices are known")
    starts, ends = list(_ints(begin)), list(_ints(end))
    starts += [0] * (x.rank - len(starts))
    ends += list(x.shape[len(ends) :])
    box = [slice(a, b).indices(n)[:2] for a, b, n in zip(starts, ends, x.shape, strict=True)]
    cut = ex.crop(x, tuple(a for a, _ in box), tuple(b - a for a, b in box))
    shrunk = attributes.integer("shrink_axis_mask")
    return ex.reshape(cut, tuple(n for axis, n in enumerate(cut.shape) if not shrunk >> axis & 1))


def _gather(attributes: _Attributes, x: Expression, indices: Expression, axis: Expression) -> Expression:
    if attributes.integer("batch_dims"):
        raise ValueError("GatherV2 with batch axes is not known")
    return ex.gather(x, indices, _ints(axis)[0] % x.rank)


def _expand_dims(_: _Attributes, x: Expression, axis: Expression) -> Expression:
    return ex.constant(np.expand_dims(_known(x), int(_known(axis))))


def _squeeze(attributes: _Attributes, x: Expression) -> Expression:
    return ex.constant(np.squeeze(_known(x), attributes.integers("squeeze_dims")))


def _shape(_: _Attributes, x: Expression) -> Expression:
    return ex.constant(np.array(x.shape, np.int32))


def _identity(_: _Attributes, x: Expression) -> Expression:
    return x


def _einsum(attributes: _Attributes, a: Expression, b: Expression) -> Expression:
    """The three products that occur, as matrix products that need no transposition of the image.

    jax.image.resize and Flax's dense layers on other axes than the last make the second and the third.
    """
    equation = attributes.text("equation")
    if equation == "abcg,gf->abcf":
        return ex.matmul(a, b)
    if equation == "abgd,gf->abdf":
        return ex.transpose(ex.matmul(ex.transpose(b, (1, 0)), a), (0, 1, 3, 2))
    if equation == "gb,cgef->bcef" and b.shape[0] == 1:
        rows = ex.matmul(ex.transpose(a, (1, 0)), ex.reshape(b, (b.shape[1], math.prod(b.shape[2:]))))
        return ex.reshape(rows, (a.shape[1], 1, *b.shape[2:]))
    raise ValueError(f"the product {equation} is not known")


def _same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    total = max((math.ceil(size / stride) - 1) * stride + kernel - size, 0)
    return total // 2, total - total // 2


def _conv2d(attributes: _Attributes, x: Expression, kernel: Expression) -> Expression:
    if attributes.text("data_format") != "NHWC" or set(attributes.integers("dilations")) != {1}:
        raise ValueError("only plain NHWC convolutions are known")
    strides = attributes.integers("strides")[1:3]
    pads: Shape = (0, 0, 0, 0)
    if attributes.text("padding") == "SAME":
        ends = [_same_padding(x.shape[1 + k], kernel.shape[k], strides[k]) for k in range(2)]
        pads = tuple(end[side] for side in range(2) for end in ends)
    planes = ex.convolution(ex.transpose(x, NHWC_TO_NCHW), ex.transpose(kernel, (3, 2, 0, 1)), strides, pads)
    return ex.transpose(planes, NCHW_TO_NHWC)


def _conv2d_backprop(
    attributes: _Attributes, size: Expression, kernel: Expression, gradient: Expression
) -> Expression:
    if attributes.text("data_format") != "NHWC" or attributes.text("padding") != "VALID":
        raise ValueError("only unpadded NHWC transposed convolutions are known")
    planes = ex.transposed_convolution(
        ex.transpose(gradient, NHWC_TO_NCHW),
        ex.transpose(kernel, (3, 2, 0, 1)),
        attributes.integers("strides")[1:3],
    )
    image = ex.transpose(planes, NCHW_TO_NHWC)
    if image.shape != _ints(size):
        raise ValueError(f"a transposed convolution gives {image.shape} instead of {_ints(size)}")
    return image


_OPERATORS: Mapping[str, _Operator] = MappingProxyType(
    {
        "Mul": _elementwise("Mul"),
        "AddV2": _elementwise("Add"),
        "Sub": _elementwise("Sub"),
        "RealDiv": _elementwise("Div"),
        "Maximum": _elementwise("Max"),
        "Minimum": _elementwise("Min"),
        "Abs": _elementwise("Abs"),
        "Neg": _elementwise("Neg"),
        "Exp": _elementwise("Exp"),
        "Tanh": _elementwise("Tanh"),
        "Reciprocal": _elementwise("Reciprocal"),
        "SelectV2": _elementwise("Where"),
        "GreaterEqual": _greater_equal,
        "Square": _square,
        "Rsqrt": _rsqrt,
        "Identity": _identity,
        "Reshape": _reshape,
        "Transpose": _transpose,
        "BroadcastTo": _broadcast_to,
        "Sum": _sum,
        "ConcatV2": _concat,
        "StridedSlice": _strided_slice,
        "GatherV2": _gather,
        "Einsum": _einsum,
        "Conv2D": _conv2d,
        "Conv2DBackpropInput": _conv2d_backprop,
        "Shape": _shape,
        "Cast": _cast,
        "Pack": _pack,
        "ExpandDims": _expand_dims,
        "Squeeze": _squeeze,
        "Range": _on_constants(np.arange),
        "Floor": _on_constants(np.floor),
        "Sign": _on_constants(np.sign),
        "FloorDiv": _on_constants(np.floor_divide),
        "FloorMod": _on_constants(np.mod),
        "NotEqual": _on_constants(np.not_equal),
        "LogicalAnd": _on_constants(np.logical_and),
        "Less": _on_constants(np.less),
        "LessEqual": _on_constants(np.less_equal),
        "Greater": _on_constants(np.greater),
    }
)
