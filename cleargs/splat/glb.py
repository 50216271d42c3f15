"""``.glb`` with KHR_gaussian_splatting: points whose attributes are the parameters of Gaussians.

Scales and opacities are stored after activation (standard deviations, and 0 to 1), rotations as x y z w, and
spherical harmonics unchanged. Programs without the extension show coloured points from COLOR_0, which is
linear. Source: the specification of the Khronos extension (release candidate of July 2026).
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cleargs.media.colour import linear_from_srgb
from cleargs.splat.constants import SH_C0, SH_DEGREES
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene

_NAME = "KHR_gaussian_splatting"
_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_PLACES = {"matrix", "translation", "rotation", "scale"}
_NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}


def glb(scene: Scene) -> bytes:
    """Encode a scene whose y axis is up, as in glTF; equal scenes give equal bytes."""
    columns = _columns(scene)
    data = b""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    for column in columns.values():
        content = column.tobytes()
        views.append(
            {"buffer": 0, "byteOffset": len(data), "byteLength": len(content), "target": _ARRAY_BUFFER}
        )
        bytewise = column.dtype == np.uint8
        accessors.append(
            {
                "bufferView": len(accessors),
                "componentType": _BYTE if bytewise else _FLOAT,
                "count": len(column),
                "type": _KINDS[column.shape[1]],
                **({"normalized": True} if bytewise else {}),
            }
        )
        data += content + bytes(-len(content) % 4)
    means = columns["POSITION"]
    accessors[0] |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    splats = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "attributes": {name: index for index, name in enumerate(columns)},
        "mode": _POINTS,
        "extensions": {_NAME: splats},
    }
    document = {
        "asset": {"version": "2.0", "generator": "ClearGS"},
        "extensionsUsed": [_NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _columns(scene: Scene) -> dict[str, NDArray[np.float32] | NDArray[np.uint8]]:
    """Return the attributes of the points: name -> values [N, 1, 3 or 4]."""
    gaussians = scene.gaussians.to("cpu").detach()
    sh = gaussians.sh.numpy()
    alpha = torch.sigmoid(gaussians.logit_opacities).numpy()[:, None]
    unit = torch.nn.functional.normalize(gaussians.rotations.double(), dim=1).float().numpy()
    colour = np.concatenate([linear_from_srgb((sh[:, 0] * SH_C0 + 0.5).clip(0, 1)), alpha], axis=1)
    columns: dict[str, NDArray[np.float32] | NDArray[np.uint8]] = {
        "POSITION": gaussians.means.numpy(),
        "COLOR_0": np.rint(colour * 255).astype(np.uint8),
        f"{_NAME}:ROTATION": np.ascontiguousarray(unit[:, [1, 2, 3, 0]]),
        f"{_NAME}:SCALE": gaussians.log_scales.exp().numpy(),
        f"{_NAME}:OPACITY": alpha,
    }
    for degree in range(gaussians.sh_degree + 1):
        for index in range(2 * degree + 1):
            name = f"{_NAME}:SH_DEGREE_{degree}_COEF_{index}"
            columns[name] = np.ascontiguousarray(sh[:, degree**2 + index])
    return columns


def from_glb(content: bytes) -> Scene:
    """Decode the Gaussians of a glb. Raises one of `cleargs.safe_io.FAULTS` if it is another file."""
    magic, _, _, length, kind = struct.unpack_from("<4sIII4s", content)
    if (magic, kind) != (b"glTF", b"JSON"):
        raise ValueError("not a .glb")
    document, data = json.loads(content[20 : 20 + length]), content[28 + length :]
    primitives = [
        primitive
        for mesh in document.get("meshes", [])
        for primitive in mesh["primitives"]
        if _NAME in primitive.get("extensions", {})
    ]
    placed = [node for node in document.get("nodes", []) if node.keys() & _PLACES]
    if len(primitives) != 1 or placed or primitives[0]["extensions"][_NAME].get("extensions"):
        raise ValueError(f"it does not have exactly one uncompressed {_NAME} without a transform")
    attributes = primitives[0]["attributes"]

    def get(name: str) -> torch.Tensor:
        accessor = document["accessors"][attributes[name]]
        view = document["bufferViews"][accessor["bufferView"]]
        number = np.dtype(_NUMBERS[accessor["componentType"]])
        width = {kind: width for width, kind in _KINDS.items()}[accessor["type"]]
        values: NDArray[Any] = np.ndarray(
            (accessor["count"], width),
            number,
            data,
            view.get("byteOffset", 0) + accessor.get("byteOffset", 0),
            (view.get("byteStride", number.itemsize * width), number.itemsize),
        )
        largest = np.iinfo(number).max if number.kind != "f" else 1
        return torch.from_numpy((values / largest).astype(np.float32))

    names = [name for name in attributes if name.startswith(f"{_NAME}:SH_DEGREE_")]
    degree = SH_DEGREES[len(names)]
    terms = [(level, term) for level in range(degree + 1) for term in range(2 * level + 1)]
    gaussians = Gaussians(
        means=get("POSITION"),
        log_scales=get(f"{_NAME}:SCALE").log(),
        rotations=get(f"{_NAME}:ROTATION")[:, [3, 0, 1, 2]],
        logit_opacities=torch.logit(get(f"{_NAME}:OPACITY")[:, 0]),
        sh=torch.stack([get(f"{_NAME}:SH_DEGREE_{level}_COEF_{term}") for level, term in terms], dim=1),
    )
    return Scene(gaussians.bounded())
