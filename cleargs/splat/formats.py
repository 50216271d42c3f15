"""Scene files for other programs, by file extension.

Formats differ in their axes. A `Scene` has those of COLMAP and of the Inria PLY: x right, y down, z forward.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cleargs.errors import InputError, StoreError
from cleargs.files import write_bytes
from cleargs.plugins import load_plugin, plugins
from cleargs.safe_io import FAULTS, faults_as, read_bytes
from cleargs.splat.compressed_ply import compressed_ply, compressed_remarks
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.glb import from_glb, glb
from cleargs.splat.ply import READ, read_ply, write_ply
from cleargs.splat.scene import Scene
from cleargs.splat.sog import from_sog, sog
from cleargs.splat.spz import SpzVersion, from_spz, spz, spz_remarks
from cleargs.splat.transforms import transform_scene
from cleargs.splat.usd import read_usd, write_usd

_AS_IS = (1.0, 1.0, 1.0)
_ABOUT_X = (1.0, -1.0, -1.0)  # to x right, y up, z back: the axes of SPZ
_ABOUT_Z = (-1.0, -1.0, 1.0)  # to x left, y up, z forward: glTF, and PLYs in the tools of PlayCanvas
_FAULTS = (*FAULTS, RuntimeError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error, cv2.error)


def _no_antialiasing(scene: Scene) -> list[str]:
    lost = "it cannot say that the scene is anti-aliased, so small things look too bold; .sog can"
    return [lost] if scene.antialias else []


@dataclass(frozen=True)
class Format:
    """A file format that scenes can be written to."""

    write: Callable[[Path, Scene], None]
    """Function that writes a scene, which already has the axes of the format."""
    axes: tuple[float, float, float]
    """Signs of the axes of a `Scene` in the file: no rotation, or half a turn about one axis."""
    y_up: bool = False
    """True: y is always up in the format."""
    read: Callable[[Path], Scene] | None = None
    """Function that reads a scene with the axes of the format."""
    remarks: Callable[[Scene], list[str]] = lambda scene: []
    """Function that names what the format loses of a scene."""


FORMATS: Mapping[str, Format] = {
    "compressed.ply": Format(
        lambda path, scene: write_bytes(path, compressed_ply(scene)),
        _AS_IS,
        read=read_ply,
        remarks=compressed_remarks,
    ),
    "ply": Format(write_ply, _AS_IS, read=read_ply),
    "sog": Format(
        lambda path, scene: write_bytes(path, sog(scene)),
        _AS_IS,
        read=lambda path: from_sog(read_bytes(path)),
    ),
    "spz": Format(
        lambda path, scene: write_bytes(path, spz(scene)),
        _ABOUT_X,
        read=lambda path: from_spz(read_bytes(path)),
        remarks=spz_remarks,
    ),
    "glb": Format(
        lambda path, scene: write_bytes(path, glb(scene)),
        _ABOUT_Z,
        y_up=True,
        read=lambda path: from_glb(read_bytes(path)),
        remarks=_no_antialiasing,
    ),
    "usdc": Format(write_usd, _ABOUT_Z, y_up=True, read=read_usd, remarks=_no_antialiasing),
}
"""File extension -> format. `format_of` takes the first match, so longer extensions come first."""


def format_of(path: Path) -> str:
    """Return the file extension of ``path`` in `FORMATS`, or that of a format from another package.

    Raises InputError if the extension is unknown.
    """
    name = path.name.lower()
    for extensions in (FORMATS, external := plugins("formats")):
        for extension in extensions:
            if name.endswith(f".{extension}"):
                return extension
    raise InputError(
        f"the file extension of {path} is not a known scene format",
        hint=f"use one of .{', .'.join((*FORMATS, *external))}",
    )


def _format(kind: str) -> Format:
    found: Format = FORMATS[kind] if kind in FORMATS else load_plugin("formats", kind)
    return found


def check_up(kind: str, up: str | None) -> None:
    """Raise InputError if the format ``kind`` does not support the up axis."""
    if up not in (None, "y") and _format(kind).y_up:
        raise InputError(f"in .{kind} files y is always up", hint="give --up y, or omit --up")


def write_scene(
    path: Path,
    scene: Scene,
    kind: str,
    *,
    turned: bool = False,
    spz_version: SpzVersion = 3,
    eyes: NDArray[np.float64] | None = None,
) -> list[str]:
    """Write a scene atomically in the format ``kind``, as `format_of` returns it. Return what is lost.

    The scene is rotated to the axes of the file unless it is ``turned`` already. A .compressed.ply is rounded
    for cameras with the centres ``eyes`` [M, 3], in the world of the scene.
    """
    target = _format(kind)
    with faults_as(InputError, f"cannot write {path}", hint="remove these Gaussians"):
        scene = replace(scene, gaussians=scene.gaussians.bounded())
    if not turned:
        scene = _turned(scene, target)
    remarks = target.remarks
    if kind == "spz":
        write_bytes(path, spz(scene, spz_version))
    elif kind == "compressed.ply":
        write_bytes(path, compressed_ply(scene, eyes))
        remarks = partial(compressed_remarks, eyes=eyes)
    else:
        target.write(path, scene)
    return [f"{path.name}: {remark}" for remark in remarks(scene)]


def read_scene(path: Path) -> Scene:
    """Read a scene file of any of the `FORMATS`, by its extension; without a known one, it is read as a PLY.

    The result has the axes of a `Scene`. Raises StoreError if the file is missing or cannot be read, and
    InputError if it is a .usdc and OpenUSD is not installed.
    """
    kind = next((kind for kind in FORMATS if path.name.lower().endswith(f".{kind}")), "ply")
    read = FORMATS[kind].read or read_ply
    with faults_as(StoreError, f"cannot read the scene {path}", hint=READ, faults=_FAULTS):
        return _turned(read(path), FORMATS[kind])


def _turned(scene: Scene, target: Format) -> Scene:
    """Turn a scene between the axes of a `Scene` and those of ``target``; half a turn is its own inverse."""
    if target.axes == _AS_IS:
        return scene
    return transform_scene(scene, scale=1.0, rotation=np.diag(target.axes), translation=np.zeros(3))


def padded(scene: Scene, sh_degree: int) -> Scene:
    """Pad the spherical harmonics of a scene with zeros to a degree (the Inria code reads degree 3 only).

    Raises InputError if the scene has a higher degree.
    """
    gaussians, coefficients = scene.gaussians, (sh_degree + 1) ** 2
    if sh_degree < gaussians.sh_degree:
        raise InputError(
            f"the scene has spherical harmonics of degree {gaussians.sh_degree}",
            hint=f"give --sh-degree {gaussians.sh_degree} or more, or omit it",
        )
    sh = torch.zeros(gaussians.num, coefficients, 3)
    sh[:, : gaussians.sh.shape[1]] = gaussians.sh
    return replace(scene, gaussians=Gaussians(**{**gaussians.tensors(), "sh": sh}))
