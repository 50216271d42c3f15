"""Scene files for other programs, by file extension.

Formats differ in their axes. A `Scene` has those of COLMAP and of the Inria PLY: x right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from cleargs.errors import InputError
from cleargs.files import atomic_path, write_bytes
from cleargs.plugins import load_plugin, plugins
from cleargs.splat.compressed_ply import compressed_ply
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.glb import glb
from cleargs.splat.ply import write_ply
from cleargs.splat.scene import Scene
from cleargs.splat.sog import sog
from cleargs.splat.spz import spz
from cleargs.splat.transforms import transform_scene

_AS_IS = (1.0, 1.0, 1.0)
_ABOUT_X = (1.0, -1.0, -1.0)  # to x right, y up, z back: the axes of SPZ
_ABOUT_Z = (-1.0, -1.0, 1.0)  # to x left, y up, z forward: glTF, and PLYs in the tools of PlayCanvas


def write_usd(path: Path, scene: Scene) -> None:
    """Write a scene whose y axis is up as ParticleField3DGaussianSplat of OpenUSD, atomically.

    Raises InputError if OpenUSD 26.03 or later (the extra ``usd``) is not installed.
    """
    try:
        from pxr import Gf, Usd, UsdGeom, UsdVol, Vt

        schema = UsdVol.ParticleField3DGaussianSplat
    except (ImportError, AttributeError) as error:
        raise InputError(
            "OpenUSD 26.03 or later is not installed", hint="pip install 'cleargs[usd]', or export a .glb"
        ) from error
    gaussians = scene.gaussians.to("cpu").detach()
    unit = torch.nn.functional.normalize(gaussians.rotations.double(), dim=1).tolist()
    with atomic_path(path) as temporary:
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        splats = schema.Define(stage, "/scene")
        stage.SetDefaultPrim(splats.GetPrim())
        splats.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(gaussians.means.numpy()))
        splats.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(gaussians.log_scales.exp().numpy()))
        splats.CreateOrientationsAttr(Vt.QuatfArray([Gf.Quatf(*quaternion) for quaternion in unit]))
        splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(torch.sigmoid(gaussians.logit_opacities).numpy()))
        splats.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
        splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(
            Vt.Vec3fArray.FromNumpy(gaussians.sh.reshape(-1, 3).contiguous().numpy())
        )
        stage.Save()


@dataclass(frozen=True)
class Format:
    """A file format that scenes can be written to."""

    write: Callable[[Path, Scene], None]
    """Function that writes a scene, which already has the axes of the format."""
    axes: tuple[float, float, float]
    """Signs of the axes of a `Scene` in the file: no rotation, or half a turn about one axis."""
    y_up: bool = False
    """True: y is always up in the format."""


FORMATS: Mapping[str, Format] = {
    "compressed.ply": Format(lambda path, scene: write_bytes(path, compressed_ply(scene)), _AS_IS),
    "ply": Format(write_ply, _AS_IS),
    "sog": Format(lambda path, scene: write_bytes(path, sog(scene)), _AS_IS),
    "spz": Format(lambda path, scene: write_bytes(path, spz(scene)), _ABOUT_X),
    "glb": Format(lambda path, scene: write_bytes(path, glb(scene)), _ABOUT_Z, y_up=True),
    "usdc": Format(write_usd, _ABOUT_Z, y_up=True),
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


def write_scene(path: Path, scene: Scene, kind: str, *, turned: bool = False) -> None:
    """Write a scene atomically in the format ``kind``, as `format_of` returns it.

    The scene is rotated to the axes of the file unless it is ``turned`` already.
    """
    target = _format(kind)
    if target.axes != _AS_IS and not turned:
        scene = transform_scene(scene, scale=1.0, rotation=np.diag(target.axes), translation=np.zeros(3))
    target.write(path, scene)


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
