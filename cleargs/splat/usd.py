"""``.usdc``: OpenUSD's ParticleField3DGaussianSplat (26.03 and later), through the extra ``usd``."""

from __future__ import annotations

from pathlib import Path

import torch

from cleargs.errors import InputError
from cleargs.files import atomic_path
from cleargs.splat.scene import Scene


def write_usd(path: Path, scene: Scene) -> None:
    """Write ``scene``, whose y is up, atomically. Raises InputError without a recent OpenUSD."""
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
