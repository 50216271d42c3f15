"""``scene.ply`` in the layout of the Inria code, which most viewers read: binary little endian, float32.

Values are stored before activation. Comments in the header store the anti-aliasing mode and the background.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from cleargs.errors import StoreError
from cleargs.files import atomic_path
from cleargs.safe_io import faults_as, open_regular
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene

_ANTIALIAS = "cleargs antialias"
_BACKGROUND = "cleargs background"
_MAX_LINE_BYTES = 4096  # maximum length of a line in the header


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
    rows = np.zeros((count, len(names)), dtype="<f4")
    rows[:, 0:3] = gaussians.means.numpy()
    rows[:, 6:9] = gaussians.sh.numpy()[:, 0]
    by_colour = gaussians.sh.numpy()[:, 1:].transpose(0, 2, 1)  # [N, 3, K - 1]
    rows[:, 9:-8] = by_colour.reshape(count, 3 * (coefficients - 1))
    rows[:, -8] = gaussians.logit_opacities.numpy()
    rows[:, -7:-4] = gaussians.log_scales.numpy()
    rows[:, -4:] = gaussians.rotations.numpy()
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {_ANTIALIAS} {'mip' if scene.antialias else 'none'}",
        f"comment {_BACKGROUND} {' '.join(repr(float(c)) for c in scene.background)}",
        f"element vertex {count}",
        *(f"property float {name}" for name in names),
        "end_header",
    ]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(rows.tobytes())


def read_ply(path: Path) -> Scene:
    """Read a scene in the Inria layout, with float32 properties in any order.

    Raises StoreError if the file is missing or truncated, lacks a property, or has a value that is not
    finite.
    """
    hint = "repeat the stage that wrote it with --force"
    with faults_as(StoreError, f"cannot read the scene {path}", hint=hint):
        with open_regular(path) as file:
            count, names, comments = _read_header(file)
            rows = np.frombuffer(file.read(), dtype="<f4").reshape(count, len(names))
        columns = {name: rows[:, index] for index, name in enumerate(names)}
        rest = sum(name.startswith("f_rest_") for name in names)
        coefficients = rest // 3 + 1
        if coefficients not in (1, 4, 9, 16) or rest % 3:
            raise ValueError(f"{rest} f_rest_ properties do not match an SH degree from 0 to 3")

        def get(*wanted: str) -> torch.Tensor:
            return torch.from_numpy(np.stack([columns[name] for name in wanted], axis=1).astype(np.float32))

        sh = torch.empty(count, coefficients, 3)
        sh[:, 0] = get("f_dc_0", "f_dc_1", "f_dc_2")
        if rest:
            by_colour = get(*(f"f_rest_{i}" for i in range(rest))).reshape(count, 3, coefficients - 1)
            sh[:, 1:] = by_colour.transpose(1, 2)
        background = tuple(float(c) for c in comments.get(_BACKGROUND, "0 0 0").split())
        if len(background) != 3:
            raise ValueError("the background does not have three values")
        gaussians = Gaussians(
            means=get("x", "y", "z"),
            log_scales=get("scale_0", "scale_1", "scale_2"),
            rotations=get("rot_0", "rot_1", "rot_2", "rot_3"),
            logit_opacities=get("opacity")[:, 0].contiguous(),
            sh=sh,
        )
        for name, values in gaussians.tensors().items():
            if not bool(torch.isfinite(values).all()):
                raise ValueError(f"some {name} are not finite")
        return Scene(gaussians, antialias=comments.get(_ANTIALIAS, "none") == "mip", background=background)


def _read_header(file: BinaryIO) -> tuple[int, list[str], dict[str, str]]:
    """Read the number of vertices, the property names and the comments of ClearGS (name -> value)."""
    lines: list[list[str]] = []
    while (line := file.readline(_MAX_LINE_BYTES)) not in (b"end_header\n", b"end_header\r\n"):
        if not line.endswith(b"\n") or len(lines) > 1000:
            raise ValueError("the header has no end")
        if words := line.decode("ascii").split():
            lines.append(words)
    if lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise ValueError("not a binary little endian PLY")
    elements = [line for line in lines if line[0] == "element"]
    if [line[:2] for line in elements] != [["element", "vertex"]] or len(elements[0]) != 3:
        raise ValueError("the file has elements other than vertices")
    if not elements[0][2].isdecimal():
        raise ValueError(f"{elements[0][2]} is not a number of vertices")
    properties = [line for line in lines if line[0] == "property"]
    if any(len(line) != 3 or line[1] not in ("float", "float32") for line in properties):
        raise ValueError("the file has properties that are not float")
    comments = {" ".join(line[1:3]): " ".join(line[3:]) for line in lines if line[0] == "comment"}
    return int(elements[0][2]), [line[2] for line in properties], comments
