#!/usr/bin/env bash
# Two Gaussians, two units apart, are written to a USD stage as ParticleField3DGaussianSplat, USD's own type for splats.
# Guess: the box of the prim is computed from positions and scales, as for points and meshes.
# Seen: without the attribute extent the box is empty, so a viewer has nothing to frame; UsdGeom.Points without extent has one.
# Exit: 0 as described, 1 changed, 2 cannot be tried here.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cannot() {
  echo "cannot be tried here: $1"
  exit 2
}
cd "$work"
python3 -m venv env || cannot "python3 with its module venv is missing"
env/bin/python -m pip install --quiet --disable-pip-version-check usd-core==26.11 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys

from pxr import Usd, UsdGeom, Vt

print("usd-core", ".".join(map(str, Usd.GetVersion())))
stage = Usd.Stage.CreateInMemory()
splats = stage.DefinePrim("/splats", "ParticleField3DGaussianSplat")
positions = Vt.Vec3fArray([(0, 0, 0), (0, 0, 2)])
splats.GetAttribute("positions").Set(positions)
splats.GetAttribute("scales").Set(Vt.Vec3fArray([(0.1, 0.1, 0.1)] * 2))
points = UsdGeom.Points.Define(stage, "/points")
points.CreatePointsAttr(positions)
points.CreateWidthsAttr([0.2, 0.2])


def box(prim):
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
    return cache.ComputeWorldBound(prim).ComputeAlignedRange()


without, of_points = box(splats), box(points.GetPrim())
splats.GetAttribute("extent").Set(Vt.Vec3fArray([(-0.3, -0.3, -0.3), (0.3, 0.3, 2.3)]))
given = box(splats)
print("guess: no box is empty")
for name, found in {"points": of_points, "splats": without, "splats with extent": given}.items():
    print(f"{name}: {'empty' if found.IsEmpty() else f'{found.GetMin()} to {found.GetMax()}'}")
as_described = without.IsEmpty() and not of_points.IsEmpty() and not given.IsEmpty()
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
