"""The converter's parts on small networks: folding, translation, fusion, the ONNX file."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cleargs.models.convert import expression as ex
from cleargs.models.convert.expression import Expression
from cleargs.models.convert.fuse import fused
from cleargs.models.convert.onnx_file import write_onnx
from cleargs.models.convert.rewrite import in_order, match
from cleargs.models.convert.tfjs import read_model, translate
from cleargs.models.onnx import OnnxModel

Array = NDArray[np.float32]


def values(*shape: int) -> Array:
    return np.random.default_rng(list(shape)).standard_normal(shape, np.float32)


def run(network: Expression, image: Array, folder: Path, name: str = "network.onnx") -> Array:
    write_onnx(folder / name, network, input_name="x", output_name="y", metadata={"made": "here"})
    return OnnxModel(folder / name).run(image)[0]


def operators(network: Expression) -> list[str]:
    return [node.op for node in in_order(network) if not node.is_constant]


# --- networks as TensorFlow spells them -------------------------------------------------------------------


def layer_norm(x: Expression) -> Expression:
    channels = x.shape[-1]
    axes = (x.rank - 1,)

    def mean(y: Expression) -> Expression:
        total = ex.reshape(ex.reduce_sum(y, axes), y.shape[:-1])
        return ex.elementwise("Mul", total, ex.constant(np.float32(1 / channels)))

    average = mean(x)
    variance = ex.elementwise(
        "Max",
        ex.constant(np.float32(0)),
        ex.elementwise("Sub", mean(ex.elementwise("Mul", x, x)), ex.elementwise("Mul", average, average)),
    )
    column = (*x.shape[:-1], 1)
    deviation = ex.elementwise(
        "Sqrt", ex.elementwise("Add", ex.reshape(variance, column), ex.constant(np.float32(1e-6)))
    )
    ones = (1,) * (x.rank - 1)
    scale = ex.elementwise(
        "Mul", ex.elementwise("Reciprocal", deviation), ex.constant(values(*ones, channels))
    )
    centred = ex.elementwise("Sub", x, ex.reshape(average, column))
    return ex.elementwise(
        "Add", ex.elementwise("Mul", centred, scale), ex.constant(values(*ones, channels) + 1)
    )


def gelu(x: Expression) -> Expression:
    def times(factor: float, y: Expression) -> Expression:
        return ex.elementwise("Mul", ex.constant(np.float32(factor)), y)

    cube = ex.elementwise("Mul", times(0.044715, x), ex.elementwise("Mul", x, x))
    inner = times(0.7978846, ex.elementwise("Add", x, cube))
    gate = ex.elementwise("Add", ex.constant(np.float32(1)), ex.elementwise("Tanh", inner))
    return ex.elementwise("Mul", times(0.5, x), gate)


def leaky(x: Expression) -> Expression:
    positive = ex.elementwise("GreaterOrEqual", x, ex.constant(np.float32(0)))
    return ex.elementwise("Where", positive, x, ex.elementwise("Mul", ex.constant(np.float32(0.2)), x))


def convolution(x: Expression, side: int, out: int) -> Expression:
    planes = ex.transpose(x, (0, 3, 1, 2))
    kernel = ex.constant(values(out, x.shape[-1], side, side) / side)
    product = ex.convolution(planes, kernel, (1, 1), (side // 2,) * 4)
    return ex.elementwise("Add", ex.transpose(product, (0, 2, 3, 1)), ex.constant(values(1, 1, 1, out)))


def dense(x: Expression, out: int) -> Expression:
    product = ex.matmul(x, ex.constant(values(x.shape[-1], out)))
    return ex.elementwise("Add", product, ex.constant(values(1, 1, 1, out)))


def gated(x: Expression) -> Expression:
    """Half the channels, mixed over the axis of the rows, gate the other half."""
    wide = gelu(dense(layer_norm(x), 2 * x.shape[-1]))
    half = (*x.shape[:-1], x.shape[-1])
    u, v = (ex.crop(wide, (0, 0, 0, first), half) for first in (0, x.shape[-1]))
    rows = ex.transpose(v, (0, 3, 2, 1))
    mixed = ex.matmul(rows, ex.constant(values(x.shape[1], x.shape[1])))
    biased = ex.elementwise("Add", mixed, ex.constant(values(1, 1, 1, x.shape[1])))
    gate = ex.elementwise("Add", ex.transpose(biased, (0, 3, 2, 1)), ex.constant(np.float32(1)))
    return ex.elementwise("Mul", u, gate)


def enlarged(x: Expression) -> Expression:
    rows, columns, channels = x.shape[1:]
    tall = ex.matmul(ex.constant(values(2 * rows, rows)), ex.reshape(x, (rows, columns * channels)))
    wide = ex.matmul(
        ex.constant(values(2 * columns, columns)), ex.reshape(tall, (2 * rows, 1, columns, channels))
    )
    planes = ex.transpose(wide, (1, 3, 0, 2))
    kernel = ex.constant(values(2, channels, 1, 1))
    return ex.transpose(ex.convolution(planes, kernel, (1, 1), (0,) * 4), (0, 2, 3, 1))


NETWORKS: dict[str, tuple[Callable[[Expression], Expression], list[str], list[str]]] = {
    # the network, what fusion must make of it, what it must leave no trace of
    "layer norm": (layer_norm, ["LayerNormalization"], ["ReduceSum", "Sqrt"]),
    "gelu": (gelu, ["Gelu"], ["Tanh"]),
    "leaky convolutions": (
        lambda x: convolution(leaky(convolution(x, 3, 4)), 3, 5),
        ["Transpose", "Conv", "LeakyRelu", "Conv", "Transpose"],
        ["Where", "Add"],
    ),
    "pointwise convolution": (lambda x: convolution(x, 1, 5), ["Gemm"], ["Conv", "Transpose"]),
    "gate": (gated, ["LayerNormalization", "Gemm", "Gelu", "Mul"], ["Slice", "Transpose", "MatMul"]),
    "joined": (
        lambda x: dense(ex.concat((x, layer_norm(x)), 3), 4),
        ["LayerNormalization", "Gemm"],
        ["Concat", "Add"],
    ),
    "enlargement": (enlarged, ["MatMul"], ["Conv", "Transpose"]),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_fusion_keeps_the_result(name: str, tmp_path: Path) -> None:
    network, made, gone = NETWORKS[name]
    image = values(1, 6, 5, 8)
    plain = network(ex.source(image.shape))
    better = fused(plain)
    assert better.shape == plain.shape
    expected = run(plain, image, tmp_path, "plain.onnx")
    assert np.abs(expected).max() > 0.1
    # float32 rounding of sums over at most 16 products of values of a few units
    np.testing.assert_allclose(run(better, image, tmp_path), expected, atol=2e-5 * np.abs(expected).max())
    assert set(made) <= set(operators(better))
    assert not set(gone) & set(operators(better))


def test_enlargement_mixes_the_channels_of_the_small_image() -> None:
    nodes = in_order(fused(enlarged(ex.source((1, 6, 5, 8)))))
    (mixing,) = (node for node in nodes if node.op == "MatMul" and node.inputs[1].shape == (8, 2))
    assert mixing.shape == (1, 6, 5, 2)


def test_variants_that_only_look_alike_are_left_alone(tmp_path: Path) -> None:
    def other(x: Expression) -> Expression:
        twice = ex.elementwise("Mul", ex.constant(np.float32(0.3)), x)  # not 0.5 x
        gate = ex.elementwise("Tanh", ex.elementwise("Mul", ex.constant(np.float32(0.7978846)), x))
        return ex.elementwise("Mul", twice, ex.elementwise("Add", ex.constant(np.float32(1)), gate))

    image = values(1, 4, 4, 3)
    network = fused(other(ex.source(image.shape)))
    assert "Tanh" in operators(network)
    expected = 0.3 * image * (1 + np.tanh(0.7978846 * image))
    np.testing.assert_allclose(run(network, image, tmp_path), expected, atol=1e-6)


def test_patterns_bind_names_to_one_thing() -> None:
    x, y = ex.source((3,)), ex.source((3,))
    square = ex.elementwise("Mul", x, x)
    assert match(("Mul", "a", "a"), square) is not None
    assert match(("Mul", "a", "a"), ex.elementwise("Mul", x, y)) is None
    shifted = ex.elementwise("Add", ex.constant(np.float32(2)), square)
    found = match(("Add", ("Mul", "a", "b"), 2.0), shifted)  # in either order
    assert found is not None and found["a"] is x
    assert match(("Add", ("Mul", "a", "b"), 2.001), shifted) is None


@settings(max_examples=30)
@given(st.permutations(range(4)), st.permutations(range(4)))
def test_layouts_in_a_row_merge(first: list[int], second: list[int]) -> None:
    x = ex.source((2, 3, 1, 5))
    network = ex.transpose(ex.transpose(x, tuple(first)), tuple(second))
    assert network.shape == tuple(np.empty(x.shape).transpose(first).transpose(second).shape)
    assert operators(network).count("Transpose") <= 1


# --- TensorFlow.js ----------------------------------------------------------------------------------------


def graph_model(nodes: list[dict[str, Any]], constants: dict[str, NDArray[Any]]) -> Callable[[str], bytes]:
    weights = [
        {"name": name, "shape": list(value.shape), "dtype": value.dtype.name}
        for name, value in constants.items()
    ]
    everything = [*nodes, *({"name": name, "op": "Const"} for name in constants)]
    data = b"".join(value.tobytes() for value in constants.values())
    model = {
        "modelTopology": {"node": everything},
        "weightsManifest": [{"paths": ["a.bin", "b.bin"], "weights": weights}],
    }
    content = {"model.json": json.dumps(model).encode(), "a.bin": data[:10], "b.bin": data[10:]}
    return content.__getitem__


def text(value: str) -> dict[str, str]:
    return {"s": base64.b64encode(value.encode()).decode()}


def conv_node(name: str, inputs: list[str], stride: int, padding: str) -> dict[str, Any]:
    attributes = {
        "data_format": text("NHWC"),
        "padding": text(padding),
        "strides": {"list": {"i": ["1", str(stride), str(stride), "1"]}},
        "dilations": {"list": {"i": ["1"] * 4}},
    }
    return {"name": name, "op": "Conv2D", "input": inputs, "attr": attributes}


@pytest.mark.parametrize(("size", "stride"), [(8, 1), (8, 2), (7, 2)])
def test_same_padding_is_tensorflows(size: int, stride: int, tmp_path: Path) -> None:
    kernel = values(3, 3, 2, 4)
    read = graph_model(
        [{"name": "x", "op": "Placeholder"}, conv_node("y", ["x", "k", "^x"], stride, "SAME")], {"k": kernel}
    )
    image = values(1, size, size, 2)
    network = translate(*read_model(read), "y", image.shape)
    # TensorFlow: ceil(size / stride) outputs, the odd pixel of padding below and right
    count = -(-size // stride)
    total = (count - 1) * stride + 3 - size
    padded = np.pad(image, ((0, 0), *[(total // 2, total - total // 2)] * 2, (0, 0)))
    expected = np.zeros((1, count, count, 4), np.float32)
    for i in range(count):
        for j in range(count):
            window = padded[0, i * stride : i * stride + 3, j * stride : j * stride + 3]
            expected[0, i, j] = np.einsum("hwc,hwcd->d", window, kernel)
    np.testing.assert_allclose(run(network, image, tmp_path), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("equation", "first", "second"),
    [
        ("abcg,gf->abcf", (1, 3, 4, 5), (5, 6)),
        ("abgd,gf->abdf", (1, 3, 5, 4), (5, 6)),
        ("gb,cgef->bcef", (5, 6), (1, 5, 3, 4)),
    ],
)
def test_products(equation: str, first: tuple[int, ...], second: tuple[int, ...], tmp_path: Path) -> None:
    image, matrix = (values(*shape) for shape in sorted((first, second), key=len, reverse=True))
    inputs = ["x", "m"] if len(first) == 4 else ["m", "x"]
    node = {"name": "y", "op": "Einsum", "input": inputs, "attr": {"equation": text(equation)}}
    read = graph_model([{"name": "x", "op": "Placeholder"}, node], {"m": matrix})
    network = translate(*read_model(read), "y", image.shape)
    operands = (image, matrix) if inputs[0] == "x" else (matrix, image)
    np.testing.assert_allclose(run(network, image, tmp_path), np.einsum(equation, *operands), atol=1e-5)


def test_arithmetic_of_shapes_vanishes(tmp_path: Path) -> None:
    # y = x reshaped to [-1, last extent of x], as a graph with a free size spells it
    nodes = [
        {"name": "x", "op": "Placeholder"},
        {"name": "shape", "op": "Shape", "input": ["x"]},
        {
            "name": "last",
            "op": "StridedSlice",
            "input": ["shape", "three", "four", "one"],
            "attr": {"shrink_axis_mask": {"i": "1"}},
        },
        {"name": "target", "op": "Pack", "input": ["minus", "last"], "attr": {"axis": {"i": "0"}}},
        {"name": "y", "op": "Reshape", "input": ["x", "target"]},
    ]
    constants = {
        "three": np.array([3], np.int32),
        "four": np.array([4], np.int32),
        "one": np.array([1], np.int32),
        "minus": np.array(-1, np.int32),
    }
    image = values(1, 2, 3, 5)
    network = translate(*read_model(graph_model(nodes, constants)), "y", image.shape)
    assert operators(network) == ["Input", "Reshape"]
    np.testing.assert_array_equal(run(network, image, tmp_path), image.reshape(6, 5))


def test_an_unknown_operator_is_named() -> None:
    read = graph_model([{"name": "x", "op": "Placeholder"}, {"name": "y", "op": "Erf", "input": ["x"]}], {})
    with pytest.raises(ValueError, match="Erf"):
        translate(*read_model(read), "y", (1, 4, 4, 3))


# --- the file ---------------------------------------------------------------------------------------------


def test_the_file_passes_the_checker_of_onnx(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx", reason="the package onnx is not installed (extra convert or train)")
    run(fused(gated(ex.source((1, 6, 5, 8)))), values(1, 6, 5, 8), tmp_path)
    model = onnx.load(str(tmp_path / "network.onnx"))
    onnx.checker.check_model(model, full_check=True)
    assert [(entry.key, entry.value) for entry in model.metadata_props] == [("made", "here")]


def test_equal_parts_are_written_once(tmp_path: Path) -> None:
    x = ex.source((1, 4, 4, 3))
    network = ex.elementwise("Add", gelu(layer_norm(x)), gelu(layer_norm(x)))
    once = gelu(layer_norm(x))
    run(network, values(1, 4, 4, 3), tmp_path, "twice.onnx")
    run(ex.elementwise("Add", once, once), values(1, 4, 4, 3), tmp_path, "once.onnx")
    assert (tmp_path / "twice.onnx").read_bytes() == (tmp_path / "once.onnx").read_bytes()
