"""Scene files for other programs, by their ending.

Each format has axes of its own. Ours are those of COLMAP and of the Inria code's PLYs: y down, z forward.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from cleargs.errors import InputError
from cleargs.files import atomic_path, write_bytes
from cleargs.plugins import load_part, plugins
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
_ABOUT_Z = (-1.0, -1.0, 1.0)  # to y up, z still forward: how glTF and PlayCanvas's tools show PLYs


def write_usd(path: Path, scene: Scene) -> None:
    """Write OpenUSD's ParticleField3DGaussianSplat (26.03 and later), atomically; y is up in ``scene``.

    Raises InputError where the extra ``usd`` is not installed.
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
    """How one kind of file is written."""

    write: Callable[[Path, Scene], None]
    axes: tuple[float, float, float]
    """Signs of our axes in the file: half a turn, or none."""
    y_up: bool = False
    """Whether the format allows no other up axis than y."""


FORMATS: Mapping[str, Format] = {
    "compressed.ply": Format(lambda path, scene: write_bytes(path, compressed_ply(scene)), _AS_IS),
    "ply": Format(write_ply, _AS_IS),
    "sog": Format(lambda path, scene: write_bytes(path, sog(scene)), _AS_IS),
    "spz": Format(lambda path, scene: write_bytes(path, spz(scene)), _ABOUT_X),
    "glb": Format(lambda path, scene: write_bytes(path, glb(scene)), _ABOUT_Z, y_up=True),
    "usdc": Format(write_usd, _ABOUT_Z, y_up=True),
}
"""Ending -> format; a longer ending stands before the one that it ends with."""


def format_of(path: Path) -> str:
    """The ending of ``path`` in `FORMATS`, or of a format that another package brings. Raises InputError for
    any other.
    """
    name = path.name.lower()
    for endings in (FORMATS, brought := plugins("formats")):
        for ending in endings:
            if name.endswith(f".{ending}"):
                return ending
    raise InputError(
        f"{path} has no ending that says what to write",
        hint=f"end it with one of .{', .'.join((*FORMATS, *brought))}",
    )


def _format(kind: str) -> Format:
    found: Format = FORMATS[kind] if kind in FORMATS else load_part("formats", kind)
    return found


def check_options(kind: str, *, up: str | None, spz_version: int | None) -> None:
    """Raise InputError for what files of ``kind`` do not have."""
    if up not in (None, "y") and _format(kind).y_up:
        raise InputError(f"in a .{kind} y is always up", hint="give --up y, or leave it out")
    if spz_version is not None and kind != "spz":
        raise InputError(f"a .{kind} has no SPZ version", hint="leave out --spz-version")


def write_scene(
    path: Path, scene: Scene, kind: str, *, turned: bool = False, spz_version: int | None = None
) -> None:
    """Write ``scene`` to ``path`` as `format_of` calls its kind, atomically.

    The scene has our axes, or with ``turned`` those that the file is to have.
    """
    target = _format(kind)
    if target.axes != _AS_IS and not turned:
        scene = transform_scene(scene, scale=1.0, rotation=np.diag(target.axes), translation=np.zeros(3))
    if spz_version is not None:
        write_bytes(path, spz(scene, spz_version))
    else:
        target.write(path, scene)


def padded(scene: Scene, sh_degree: int) -> Scene:
    """``scene`` with zeros for spherical harmonics up to ``sh_degree``: the Inria code reads degree 3 only.

    Raises InputError when the scene has a higher degree.
    """
    gaussians, coefficients = scene.gaussians, (sh_degree + 1) ** 2
    if sh_degree < gaussians.sh_degree:
        raise InputError(
            f"the scene has spherical harmonics of degree {gaussians.sh_degree}",
            hint=f"give --sh-degree {gaussians.sh_degree} or more, or leave it out",
        )
    sh = torch.zeros(gaussians.num, coefficients, 3)
    sh[:, : gaussians.sh.shape[1]] = gaussians.sh
    return replace(scene, gaussians=Gaussians(**{**gaussians.tensors(), "sh": sh}))
