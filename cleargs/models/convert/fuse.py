"""Rules that turn what TensorFlow spells out into what onnxruntime computes fast.

Most of a spelt-out network's time goes into elementwise operators, each of which reads and writes the whole
image, and into transpositions between pixel-last (TensorFlow) and pixel-first (ONNX) convolutions.
"""

from __future__ import annotations

import math

import numpy as np

from cleargs.models.convert import expression as ex
from cleargs.models.convert.expression import Expression, Shape
from cleargs.models.convert.rewrite import Pattern, Rule, match, rewrite


def merged_layout(node: Expression) -> Expression | None:
    """Two reshapes or two transpositions in a row are one, or none."""
    if node.op not in ("Reshape", "Transpose"):
        return None
    x, axes = node.inputs[0], node.attributes.get("perm")
    if isinstance(axes, tuple) and _keeps_order(x.shape, axes):
        return ex.reshape(x, node.shape)
    if x.op == node.op or x.is_constant or (node.op == "Reshape" and x.shape == node.shape):
        return ex.transpose(x, axes) if isinstance(axes, tuple) else ex.reshape(x, node.shape)
    return None


def _keeps_order(shape: Shape, axes: Shape) -> bool:
    moved = [axis for axis in axes if shape[axis] > 1]
    return moved == sorted(moved)


_MEAN: Pattern = ("Mul", ("ReduceSum", "x", "axes"), "1/n")
_MEAN_OF_SQUARES: Pattern = ("Mul", ("ReduceSum", ("Mul", "x", "x"), "axes of squares"), "1/n")
_VARIANCE: Pattern = ("Max", 0.0, ("Sub", _MEAN_OF_SQUARES, ("Mul", _MEAN, _MEAN)))
_DEVIATION: Pattern = ("Sqrt", ("Add", _VARIANCE, "epsilon"))
_LAYER_NORM: Pattern = (
    "Add",
    ("Mul", ("Sub", "x", _MEAN), ("Mul", ("Reciprocal", _DEVIATION), "scale")),
    "bias",
)


def layer_norm(node: Expression) -> Expression | None:
    """Flax's LayerNorm over the last axis."""
    found = match(_LAYER_NORM, node) if node.op == "Add" else None
    if found is None or not all(found[name].is_constant for name in ("scale", "bias", "epsilon")):
        return None
    x = found["x"]
    channels = (x.shape[-1],)
    axes = [found[name].value for name in ("axes", "axes of squares")]
    if any(a is None or a.tolist() != [x.rank - 1] for a in axes) or node.shape != x.shape:
        return None
    scale, bias = (ex.reshape(found[name], channels) for name in ("scale", "bias"))
    epsilon = found["epsilon"].value
    assert epsilon is not None
    return Expression(
        "LayerNormalization", (x, scale, bias), {"axis": -1, "epsilon": float(epsilon)}, x.shape
    )


_CUBIC: Pattern = ("Add", "x", ("Mul", ("Mul", 0.044715, "x"), ("Mul", "x", "x")))
_GELU: Pattern = (
    "Mul",
    ("Mul", 0.5, "x"),
    ("Add", 1.0, ("Tanh", ("Mul", math.sqrt(2.0 / math.pi), _CUBIC))),
)


def gelu(node: Expression) -> Expression | None:
    """GELU by its approximation with tanh."""
    found = match(_GELU, node) if node.op == "Mul" else None
    if found is None:
        return None
    return Expression("Gelu", (found["x"],), {"approximate": "tanh"}, node.shape)


_LEAKY_RELU: Pattern = ("Where", ("GreaterOrEqual", "x", 0.0), "x", ("Mul", "slope", "x"))


def leaky_relu(node: Expression) -> Expression | None:
    """x where it is positive, a fraction of it elsewhere."""
    found = match(_LEAKY_RELU, node) if node.op == "Where" else None
    if found is None or (slope := found["slope"].value) is None or slope.size != 1:
        return None
    return Expression("LeakyRelu", (found["x"],), {"alpha": float(slope.item())}, node.shape)


def pointwise_convolution(node: Expression) -> Expression | None:
    """A convolution of single pixels is a matrix product of pixels and needs no transposition."""
    if node.op != "Conv" or node.attributes["kernel_shape"] != (1, 1) or len(node.inputs) == 3:
        return None
    x, kernel = node.inputs
    if node.attributes["strides"] != (1, 1) or x.op != "Transpose":
        return None
    weights = ex.transpose(ex.reshape(kernel, kernel.shape[:2]), (1, 0))
    return ex.transpose(ex.matmul(ex.transpose(x, (0, 2, 3, 1)), weights), (0, 3, 1, 2))


def _weights(node: Expression) -> Expression | None:
    """The matrix of a dense layer; None for anything else."""
    dense = node.op == "MatMul" and node.inputs[1].is_constant and node.inputs[1].rank == 2
    return node.inputs[1] if dense else None


def channels_before_enlargement(node: Expression) -> Expression | None:
    """A dense layer on an enlarged image: mix the channels of the small image and enlarge the result.

    An enlargement along an axis is a product with a constant matrix from the left, between reshapes.
    """
    weights = _weights(node)
    enlarged = node.inputs[0].inputs[0] if weights and node.inputs[0].op == "Reshape" else None
    enlarged = enlarged or (node.inputs[0] if weights else None)
    if weights is None or enlarged is None or enlarged.op != "MatMul" or not enlarged.inputs[0].is_constant:
        return None
    factors, small = enlarged.inputs
    channels, result = weights.shape
    image = small
    if small.op == "Reshape" and small.shape[-1] != channels:
        image = small.inputs[0]
    if factors.rank != 2 or factors.shape[0] <= factors.shape[1] or small.rank < 2:
        return None
    if image.shape[-1] != channels or node.inputs[0].shape[-1] != channels or small.shape[-1] % channels:
        return None
    mixed = ex.reshape(ex.matmul(image, weights), (*small.shape[:-1], small.shape[-1] // channels * result))
    return ex.reshape(ex.matmul(factors, mixed), node.shape)


def channels_of_each_input(node: Expression) -> Expression | None:
    """A dense layer on joined channels is the sum of one on each of the inputs."""
    weights = _weights(node)
    joined = node.inputs[0] if weights else None
    if weights is None or joined is None or joined.op != "Concat":
        return None
    if joined.attributes["axis"] != joined.rank - 1:
        return None
    total, start = None, 0
    for x in joined.inputs:
        part = ex.matmul(x, ex.crop(weights, (start, 0), (x.shape[-1], weights.shape[1])))
        total = part if total is None else ex.elementwise("Add", total, part)
        start += x.shape[-1]
    return total


def crop_of_channels(node: Expression) -> Expression | None:
    """Do not compute channels that are cut away."""
    if node.op != "Slice":
        return None
    x, start, _, axes = node.inputs
    assert start.value is not None and axes.value is not None
    if axes.value.tolist() != [x.rank - 1]:
        return None
    first, count = int(start.value[0]), node.shape[-1]

    def cut(part: Expression) -> Expression:
        return ex.crop(part, (*(0,) * (part.rank - 1), first), (*part.shape[:-1], count))

    if x.op == "Gelu":
        return Expression(x.op, (cut(x.inputs[0]),), x.attributes, node.shape)
    if x.op == "Add" and all(part.rank and part.shape[-1] == x.shape[-1] for part in x.inputs):
        return ex.elementwise("Add", *(cut(part) for part in x.inputs))
    if weights := _weights(x):
        return ex.matmul(x.inputs[0], cut(weights))
    return None


def product_over_other_axis(node: Expression) -> Expression | None:
    """A matrix product over another axis than the last: swap the factors instead of the axes."""
    if node.op != "MatMul" or node.inputs[0].op != "Transpose" or node.inputs[1].rank != 2:
        return None
    transposed, weights = node.inputs
    if not weights.is_constant:
        return None
    x, axes = transposed.inputs[0], transposed.attributes["perm"]
    assert isinstance(axes, tuple)
    axis, left = axes[-1], ex.transpose(weights, (1, 0))
    shape = (*x.shape[:axis], weights.shape[1], *x.shape[axis + 1 :])
    rows, columns = math.prod(x.shape[:axis]), math.prod(x.shape[axis + 1 :])
    if axis == x.rank - 1:
        return None
    matrices = (x.shape[axis], columns) if rows == 1 else (rows, x.shape[axis], columns)
    return ex.transpose(ex.reshape(ex.matmul(left, ex.reshape(x, matrices)), shape), axes)


def constant_after_transpose(node: Expression) -> Expression | None:
    """Combine with constants before a transposition instead of after it."""
    if node.op not in ("Add", "Mul"):
        return None
    for x, other in (node.inputs, node.inputs[::-1]):
        if x.op == "Transpose" and other.is_constant and x.shape == node.shape:
            axes = x.attributes["perm"]
            assert isinstance(axes, tuple)
            aligned = ex.reshape(other, (1,) * (x.rank - other.rank) + other.shape)
            back = tuple(int(axis) for axis in np.argsort(axes))
            return ex.transpose(ex.elementwise(node.op, x.inputs[0], ex.transpose(aligned, back)), axes)
    return None


def constant_after_reshape(node: Expression) -> Expression | None:
    """Likewise for a scalar after a reshape."""
    if node.op not in ("Add", "Mul"):
        return None
    for x, other in (node.inputs, node.inputs[::-1]):
        if x.op == "Reshape" and other.value is not None and other.value.size == 1 and x.shape == node.shape:
            scalar = ex.reshape(other, ())
            return ex.reshape(ex.elementwise(node.op, x.inputs[0], scalar), x.shape)
    return None


def activation_after_transpose(node: Expression) -> Expression | None:
    """Activate before a transposition instead of after it, where it joins the convolution."""
    if node.op != "LeakyRelu" or node.inputs[0].op != "Transpose":
        return None
    inner = node.inputs[0]
    axes = inner.attributes["perm"]
    assert isinstance(axes, tuple)
    x = inner.inputs[0]
    return ex.transpose(Expression(node.op, (x,), node.attributes, x.shape), axes)


def sum_of_constants(node: Expression) -> Expression | None:
    """(x + a) + b = x + (a + b)."""
    found = match(("Add", ("Add", "x", "a"), "b"), node) if node.op == "Add" else None
    if found is None or not (found["a"].is_constant and found["b"].is_constant):
        return None
    if found["x"].shape != node.shape or node.inputs[0].op == "Reshape" or node.inputs[1].op == "Reshape":
        return None
    return ex.elementwise("Add", found["x"], ex.elementwise("Add", found["a"], found["b"]))


def constant_beside_product(node: Expression) -> Expression | None:
    """(A B + x) + c = (A B + c) + x: the operator that multiplies takes the constant along."""
    found = match(("Add", ("Add", "product", "x"), "c"), node) if node.op == "Add" else None
    if found is None or found["product"].op != "MatMul" or found["x"].is_constant:
        return None
    if not found["c"].is_constant or found["product"].shape != node.shape:
        return None
    return ex.elementwise("Add", ex.elementwise("Add", found["product"], found["c"]), found["x"])


def convolution_bias(node: Expression) -> Expression | None:
    """A convolution adds a constant to each channel itself."""
    if node.op != "Add":
        return None
    for x, other in (node.inputs, node.inputs[::-1]):
        channels = (1, x.shape[1], 1, 1) if x.rank == 4 else None
        if x.op in ("Conv", "ConvTranspose") and len(x.inputs) == 2 and other.is_constant:
            if other.shape != channels:
                return None
            bias = ex.reshape(other, (x.shape[1],))
            return Expression(x.op, (*x.inputs, bias), x.attributes, x.shape)
    return None


def gemm(node: Expression) -> Expression | None:
    """A matrix product and a sum in one operator.

    What is added may be a constant for each row or column or a full matrix.
    """
    if node.op != "Add":
        return None
    for x, other in (node.inputs, node.inputs[::-1]):
        product = x.inputs[0] if x.op == "Reshape" else x
        if product.op != "MatMul" or x.shape != node.shape:
            continue
        a, b = product.inputs
        if b.rank == 2 and b.is_constant:
            a = ex.reshape(a, (math.prod(a.shape[:-1]), a.shape[-1]))
        elif a.rank != 2 or b.rank != 2:
            continue
        rows = (a.shape[0], b.shape[1])
        added = _as_addend(other, node.shape, rows)
        if added is not None:
            return ex.reshape(Expression("Gemm", (a, b, added), {}, rows), node.shape)
    return None


def _as_addend(x: Expression, shape: Shape, matrix: Shape) -> Expression | None:
    """``x``, which is broadcast to ``shape``, as what is broadcast to the matrix of the same elements."""
    if x.shape == shape:
        return ex.reshape(x, matrix)
    count = math.prod(x.shape)
    if x.is_constant and x.rank and count == x.shape[-1] == matrix[1]:
        return ex.reshape(x, (count,))
    aligned = (1,) * (len(shape) - x.rank) + x.shape
    if (
        x.is_constant
        and count == matrix[0] == shape[aligned.index(count)]
        and math.prod(shape[: aligned.index(count)]) == 1
    ):
        return ex.reshape(x, (count, 1))
    return None


RECOGNISE: tuple[Rule, ...] = (merged_layout, layer_norm, gelu, leaky_relu)
"""What TensorFlow spelt out."""

REARRANGE: tuple[Rule, ...] = (
    merged_layout,
    pointwise_convolution,
    product_over_other_axis,
    constant_after_transpose,
    constant_after_reshape,
    activation_after_transpose,
    sum_of_constants,
    constant_beside_product,
    convolution_bias,
    channels_before_enlargement,
    channels_of_each_input,
    crop_of_channels,
)
"""What saves arithmetic and copies."""

COMBINE: tuple[Rule, ...] = (merged_layout, gemm)
"""What onnxruntime does in one pass."""


def fused(x: Expression) -> Expression:
    """The same network in fewer and larger operators."""
    for rules in (RECOGNISE, REARRANGE, COMBINE):
        x = rewrite(x, rules)
    return x
