"""``.usdc`` with ParticleField3DGaussianSplat of OpenUSD: activated scales and opacities, and y up.

The stage has metres as its unit; a program that heeds units reads a stage without one as centimetres. The
extent is stored, because OpenUSD has no plug-in that computes it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from cleargs.errors import InputError
from cleargs.files import atomic_path
from cleargs.media.colour import linear_from_srgb
from cleargs.splat.constants import SH_C0
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene

_SIGMAS = 3.0  # in the extent; farther out, a Gaussian has less than 1 % of its opacity


def _particle_field() -> Any:
    """Return the schema of Gaussians. Raises InputError if OpenUSD 26.03 or later is not installed."""
    try:
        from pxr import UsdVol

        return UsdVol.ParticleField3DGaussianSplat
    except (ImportError, AttributeError) as error:
        raise InputError(
            "OpenUSD 26.03 or later is not installed", hint="pip install 'cleargs[usd]', or use a .glb"
        ) from error


def write_usd(path: Path, scene: Scene) -> None:
    """Write a scene whose y axis is up, atomically. Raises InputError without the extra ``usd``."""
    schema = _particle_field()
    from pxr import Gf, Usd, UsdGeom, Vt

    gaussians = scene.gaussians.to("cpu").detach()
    unit = torch.nn.functional.normalize(gaussians.rotations.double(), dim=1).tolist()
    means, sizes = gaussians.means.numpy(), gaussians.log_scales.exp().numpy()
    margin = _SIGMAS * sizes.max(axis=1, keepdims=True)
    extent = np.stack([(means - margin).min(axis=0), (means + margin).max(axis=0)])
    colours = (gaussians.sh.numpy()[:, 0] * np.float32(SH_C0) + np.float32(0.5)).clip(0, 1)
    with atomic_path(path) as temporary:
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        splats = schema.Define(stage, "/scene")
        stage.SetDefaultPrim(splats.GetPrim())
        splats.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
        splats.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(means))
        splats.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(sizes))
        splats.CreateOrientationsAttr(Vt.QuatfArray([Gf.Quatf(*quaternion) for quaternion in unit]))
        splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(torch.sigmoid(gaussians.logit_opacities).numpy()))
        splats.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
        harmonics = splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(
            Vt.Vec3fArray.FromNumpy(gaussians.sh.reshape(-1, 3).contiguous().numpy())
        )
        harmonics.SetMetadata("interpolation", UsdGeom.Tokens.vertex)
        harmonics.SetMetadata("elementSize", gaussians.sh.shape[1])
        shown = splats.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        shown.Set(Vt.Vec3fArray.FromNumpy(linear_from_srgb(colours)))
        stage.Save()


def read_usd(path: Path) -> Scene:
    """Read the Gaussians of a stage with y up. Raises ValueError if it has not exactly one field of them."""
    schema = _particle_field()
    from pxr import Gf, Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise ValueError("not a USD stage") from error
    fields = [prim for prim in stage.Traverse() if prim.IsA(schema)]
    if len(fields) != 1 or UsdGeom.GetStageUpAxis(stage) != UsdGeom.Tokens.y:
        raise ValueError("it does not have exactly one ParticleField3DGaussianSplat, with y up")
    (prim,) = fields
    if UsdGeom.XformCache().GetLocalToWorldTransform(prim) != Gf.Matrix4d(1.0):
        raise ValueError("its Gaussians have a transform")

    def get(name: str) -> torch.Tensor:
        value = prim.GetAttribute(name).Get()
        value = prim.GetAttribute(f"{name}h").Get() if value is None else value  # half precision
        if value is None:
            raise KeyError(name)
        return torch.from_numpy(np.array(value, np.float32))

    means = get("positions")
    gaussians = Gaussians(
        means=means,
        log_scales=get("scales").log(),
        rotations=get("orientations")[:, [3, 0, 1, 2]],  # x y z w -> w x y z
        logit_opacities=torch.logit(get("opacities")),
        sh=get("radiance:sphericalHarmonicsCoefficients").reshape(len(means), -1, 3),
    )
    return Scene(gaussians.bounded())
