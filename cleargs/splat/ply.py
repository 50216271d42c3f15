"""``scene.ply`` in the layout of the Inria code, which most viewers read: binary little endian, float32.

Values are stored before activation. Comments in the header store the anti-aliasing mode and the background.
PLYs of other programs are read as well: text, big endian, other number types, and ``.compressed.ply``.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from cleargs.errors import StoreError
from cleargs.files import atomic_path
from cleargs.safe_io import faults_as, open_regular
from cleargs.splat.compressed_ply import unpacked
from cleargs.splat.constants import SH_C0
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene

READ = (
    "give Gaussians of degree 0 to 3 as .ply (text or binary), .compressed.ply, .sog (version 2), "
    ".spz (1 to 4), .glb (KHR_gaussian_splatting) or .usdc"
)
"""The scene files that are read, for hints."""

_BACKGROUND = "cleargs background"
_MODES = {
    "splatrendermode mip": True,  # Brush, splat-transform, ClearGS
    "splatrendermode default": False,
    "antialiased 1": True,  # Postshot
    "antialiased 0": False,
    "cleargs antialias mip": True,  # ClearGS up to 0.2
    "cleargs antialias none": False,
}
_ROWS = 65536  # Gaussians that are written at a time, so that there is no second copy of a scene
_MAX_LINE_BYTES = 4096  # maximum length of a line in the header
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


def mode_comment(antialias: bool) -> str:
    """Return the comment with the anti-aliasing mode, as Brush and splat-transform read it."""
    return f"comment SplatRenderMode: {'mip' if antialias else 'default'}"


def write_ply(path: Path, scene: Scene) -> None:
    """Write a scene atomically; equal scenes give equal bytes."""
    gaussians = scene.gaussians.to("cpu").detach()
    count, coefficients = gaussians.num, gaussians.sh.shape[1]
    names = [  # in the order of the Inria code
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * (coefficients - 1))),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        mode_comment(scene.antialias),
        f"comment {_BACKGROUND} {' '.join(repr(float(c)) for c in scene.background)}",
        f"element vertex {count}",
        *(f"property float {name}" for name in names),
        "end_header",
    ]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        for begin in range(0, count, _ROWS):
            file.write(_rows(gaussians, slice(begin, begin + _ROWS), len(names)).data)


def _rows(gaussians: Gaussians, part: slice, width: int) -> NDArray[np.float32]:
    """Return rows of the table of a PLY, with ``width`` columns; normals are 0."""
    means, sh = gaussians.means.numpy()[part], gaussians.sh.numpy()[part]
    rows = np.zeros((len(means), width), dtype="<f4")
    rows[:, 0:3] = means
    rows[:, 6:9] = sh[:, 0]
    rows[:, 9:-8] = sh[:, 1:].transpose(0, 2, 1).reshape(len(means), width - 17)  # by colour
    rows[:, -8] = gaussians.logit_opacities.numpy()[part]
    rows[:, -7:-4] = gaussians.log_scales.numpy()[part]
    rows[:, -4:] = gaussians.rotations.numpy()[part]
    return rows


def read_ply(path: Path) -> Scene:
    """Read a PLY of Gaussians: the Inria layout with properties in any order, or a compressed one.

    Raises StoreError if the file is missing or truncated, lacks a property, or has a value that is not
    finite (an infinite opacity becomes a large one).
    """
    made = (path.parent / "manifest.json").is_file()
    hint = "repeat the stage that wrote it with --force" if made else READ
    with faults_as(StoreError, f"cannot read the scene {path}", hint=hint):
        with open_regular(path) as file:
            elements, comments = _elements(file)
        gaussians = unpacked(elements) if "chunk" in elements else _gaussians(elements["vertex"])
        antialias, background = False, (0.0, 0.0, 0.0)
        for comment in comments:
            antialias = _MODES.get(" ".join(comment.lower().replace(":", " ").split()), antialias)
            if comment.startswith(_BACKGROUND):
                red, green, blue = map(float, comment.split()[2:])
                background = (red, green, blue)
        return Scene(gaussians.bounded(), antialias=antialias, background=background)


def _gaussians(vertex: NDArray[np.void]) -> Gaussians:
    """Return the Gaussians of the structured rows ``vertex`` with the properties of the Inria code.

    Colours may be red, green and blue instead of coefficients, as nerfstudio writes them.
    """
    names, count = vertex.dtype.names or (), len(vertex)

    def get(*wanted: str) -> torch.Tensor:
        if missing := [name for name in wanted if name not in names]:
            raise KeyError(missing[0])
        return torch.from_numpy(np.stack([vertex[name] for name in wanted], axis=1).astype(np.float32))

    rest = sum(name.startswith("f_rest_") for name in names)
    coefficients = rest // 3 + 1
    if coefficients not in (1, 4, 9, 16) or rest % 3:
        raise ValueError(f"{rest} f_rest_ properties do not match an SH degree from 0 to 3")
    sh = torch.empty(count, coefficients, 3)
    if "f_dc_0" not in names and "red" in names:
        largest = 255.0 if vertex.dtype["red"].kind == "u" else 1.0
        sh[:, 0] = (get("red", "green", "blue") / largest - 0.5) / SH_C0
    else:
        sh[:, 0] = get("f_dc_0", "f_dc_1", "f_dc_2")
    if rest:
        by_colour = get(*(f"f_rest_{i}" for i in range(rest))).reshape(count, 3, coefficients - 1)
        sh[:, 1:] = by_colour.transpose(1, 2)
    return Gaussians(
        means=get("x", "y", "z"),
        log_scales=get("scale_0", "scale_1", "scale_2"),
        rotations=get("rot_0", "rot_1", "rot_2", "rot_3"),
        logit_opacities=get("opacity")[:, 0].contiguous(),
        sh=sh,
    )


def _elements(file: BinaryIO) -> tuple[Mapping[str, NDArray[np.void]], Sequence[str]]:
    """Read the elements of a PLY (name -> structured rows) before the first with lists, and its comments."""
    order, layout, comments = _read_header(file)
    data: Any = file.read()
    if not order:
        data = np.fromstring(data.decode("ascii"), sep=" ")
    elements, offset = {}, 0
    for name, count, properties in layout:
        if any(words[0] == "list" for words in properties):
            break  # faces; the Gaussians come first
        kind = np.dtype([(words[1], order + _TYPES[words[0]]) for words in properties])
        if order:
            elements[name] = np.frombuffer(data, kind, count, offset)
            offset += count * kind.itemsize
        else:
            numbers = data[offset : offset + count * len(properties)].reshape(count, len(properties))
            elements[name] = np.rec.fromarrays(numbers.T, dtype=kind) if count else np.zeros(0, kind)
            offset += numbers.size
    else:
        if offset != len(data):
            raise ValueError("the file is longer than its header says")
    return elements, comments


def _read_header(file: BinaryIO) -> tuple[str, list[tuple[str, int, list[list[str]]]], list[str]]:
    """Return the byte order ("": text), the elements (name, count, properties as words), and the comments."""
    lines: list[list[str]] = []
    while (line := file.readline(_MAX_LINE_BYTES)) not in (b"end_header\n", b"end_header\r\n"):
        if not line.endswith(b"\n") or len(lines) > 1000:
            raise ValueError("the header has no end")
        if words := line.decode("utf-8", "replace").split():
            lines.append(words)
    if lines[:1] != [["ply"]] or lines[1][0] != "format" or lines[1][1] not in _FORMATS:
        raise ValueError("not a PLY")
    layout: list[tuple[str, int, list[list[str]]]] = []
    for words in lines[2:]:
        if words[0] == "element":
            _, name, count = words
            if not count.isdecimal() or int(count) > sys.maxsize:
                raise ValueError(f"{count} is not a number of elements")
            layout.append((name, int(count), []))
        elif words[0] == "property":
            layout[-1][2].append(words[1:])
    comments = [" ".join(words[1:]) for words in lines if words[0] == "comment"]
    return _FORMATS[lines[1][1]], layout, comments
