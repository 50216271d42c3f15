"""ONNX files of users: one file is the whole model, and files that cannot run give an error of one line."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from cleargs.errors import InputError
from cleargs.models.onnx import OnnxModel

WEIGHTS = struct.pack("<3f", 2.0, 3.0, 4.0)


def varint(number: int) -> bytes:
    low, rest = number & 127, number >> 7
    return bytes([low | 128]) + varint(rest) if rest else bytes([low])


def field(number: int, value: int | str | bytes) -> bytes:
    """Encode a field of a protocol buffer."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def image(name: str) -> bytes:
    """Encode an input or output [1, 3, h, w]."""
    shape = b"".join(field(1, extent) for extent in (field(1, 1), field(1, 3), field(2, "h"), field(2, "w")))
    return field(1, name) + field(2, field(1, field(1, 1) + field(2, shape)))


def multiplier(weights: bytes, *, as_attribute: bool = False) -> bytes:
    """Encode a model y = x * w for [1, 3, h, w], with the tensor data of the three weights."""
    tensor = b"".join(field(1, extent) for extent in (1, 3, 1, 1)) + field(2, 1) + field(8, "w") + weights
    graph = field(11, image("x")) + field(12, image("y")) + field(2, "g")
    if as_attribute:
        value = field(1, "value") + field(5, tensor) + field(20, 4)
        graph += field(1, field(2, "w") + field(4, "Constant") + field(5, value))
    else:
        graph += field(5, tensor)
    graph += field(1, field(1, "x") + field(1, "w") + field(2, "y") + field(4, "Mul"))
    return field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 17))


def test_the_model_of_these_tests_runs(tmp_path: Path) -> None:
    (tmp_path / "m.onnx").write_bytes(multiplier(field(9, WEIGHTS)))
    result = OnnxModel(tmp_path / "m.onnx").run(np.ones((1, 3, 1, 1), np.float32))
    assert result[0].ravel().tolist() == [2.0, 3.0, 4.0]


@pytest.mark.parametrize("as_attribute", [False, True])
@pytest.mark.parametrize("location", ["weights.bin", "{folder}/weights.bin", "sub/../weights.bin"])
def test_weights_in_another_file_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, location: str, as_attribute: bool
) -> None:
    """The digest does not cover other files, so a change in them would not be noticed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sub").mkdir()
    (tmp_path / "weights.bin").write_bytes(WEIGHTS)
    entry = field(13, field(1, "location") + field(2, location.format(folder=tmp_path)))
    (tmp_path / "m.onnx").write_bytes(multiplier(entry + field(14, 1), as_attribute=as_attribute))
    with pytest.raises(InputError, match="it stores weights in other files"):
        OnnxModel(tmp_path / "m.onnx")


def test_a_fifo_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "m.onnx")
    with pytest.raises(InputError, match="not a regular file"):
        OnnxModel(tmp_path / "m.onnx")


def test_a_model_that_exceeds_memory_raises_memory_error(tmp_path: Path) -> None:
    """For 2^50 values onnxruntime reports a failed allocation, which is not an error in the file."""
    dims = field(1, 1) + field(2, 7) + field(8, "n") + field(9, struct.pack("<q", 2**50))
    graph = field(5, field(1, 1) + dims[2:]) + field(2, "g")
    graph += field(1, field(1, "n") + field(2, "y") + field(4, "ConstantOfShape"))
    graph += field(11, image("x")) + field(12, image("y"))
    (tmp_path / "m.onnx").write_bytes(field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 17)))
    with pytest.raises(MemoryError):
        OnnxModel(tmp_path / "m.onnx").run(np.ones((1, 3, 1, 1), np.float32))
