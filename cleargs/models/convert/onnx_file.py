"""Writing an expression as an ONNX file, without the package ``onnx``.

An ONNX file is one protocol-buffer message; the few fields needed are written here (field numbers: onnx.proto
of ONNX 1.15).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cleargs.models.convert.expression import Attribute, Expression, Shape
from cleargs.models.convert.rewrite import in_order

_IR_VERSION = 9
_OPSET = 20
_ELEMENT_TYPES = {"float32": 1, "int32": 6, "int64": 7, "bool": 9}


def write_onnx(
    path: Path, x: Expression, *, input_name: str, output_name: str, metadata: Mapping[str, str]
) -> None:
    """Write the network that computes ``x`` from its one float32 input."""
    path.write_bytes(_model(x, input_name, output_name, metadata))


def _model(x: Expression, input_name: str, output_name: str, metadata: Mapping[str, str]) -> bytes:
    graph = bytearray()
    names: dict[Expression, str] = {}
    written: dict[Any, str] = {}  # equal operators on equal inputs are written once
    for node in in_order(x):
        if node.op == "Input":
            names[node] = input_name
            graph += _message(11, _value(input_name, node.shape))
            continue
        key: Any
        if node.value is not None:
            array = np.ascontiguousarray(node.value)
            key = (array.dtype.str, array.shape, array.tobytes())
        else:
            key = (node.op, tuple(names[i] for i in node.inputs), tuple(sorted(node.attributes.items())))
        if key not in written:
            written[key] = output_name if node is x else f"{node.op.lower()}_{len(written)}"
            if node.value is not None:
                graph += _message(5, _tensor(written[key], array))
            else:
                graph += _message(1, _node(node, [names[i] for i in node.inputs], written[key]))
        names[node] = written[key]
    graph += _message(2, b"network") + _message(12, _value(output_name, x.shape))
    model = _integer(1, _IR_VERSION) + _message(2, b"ClearGS") + _message(7, bytes(graph))
    model += _message(8, _message(1, b"") + _integer(2, _OPSET))
    for key, value in metadata.items():
        model += _message(14, _message(1, key.encode()) + _message(2, value.encode()))
    return model


def _node(node: Expression, inputs: list[str], output: str) -> bytes:
    data = b"".join(_message(1, name.encode()) for name in inputs)
    data += _message(2, output.encode()) + _message(3, output.encode()) + _message(4, node.op.encode())
    return data + b"".join(_message(5, _attribute(name, value)) for name, value in node.attributes.items())


def _attribute(name: str, value: Attribute) -> bytes:
    data = _message(1, name.encode())
    if isinstance(value, float):
        return data + _varint(2 << 3 | 5) + np.float32(value).tobytes() + _integer(20, 1)
    if isinstance(value, int):
        return data + _integer(3, value) + _integer(20, 2)
    if isinstance(value, str):
        return data + _message(4, value.encode()) + _integer(20, 3)
    return data + b"".join(_integer(8, i) for i in value) + _integer(20, 7)


def _tensor(name: str, array: NDArray[Any]) -> bytes:
    data = b"".join(_integer(1, extent) for extent in array.shape)
    data += _integer(2, _ELEMENT_TYPES[array.dtype.name]) + _message(8, name.encode())
    return data + _message(9, array.astype(array.dtype.newbyteorder("<")).tobytes())


def _value(name: str, shape: Shape) -> bytes:
    extents = b"".join(_message(1, _integer(1, extent)) for extent in shape)
    tensor = _integer(1, _ELEMENT_TYPES["float32"]) + _message(2, extents)
    return _message(1, name.encode()) + _message(2, _message(1, tensor))


def _message(field: int, data: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _integer(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _varint(value: int) -> bytes:
    value &= (1 << 64) - 1  # negative numbers are written as 64-bit two's complement
    data = bytearray()
    while value >= 0x80:
        data.append(value & 0x7F | 0x80)
        value >>= 7
    data.append(value)
    return bytes(data)
