#!/usr/bin/env bash
# The mean reprojection error of a model whose camera was made 10 % longer.
# Guess: Reconstruction.compute_mean_reprojection_error() computes the error, so it rises.
# Seen: it averages errors that are stored with the points; it stays until update_point_3d_errors() is called.
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
env/bin/python -m pip install --quiet --disable-pip-version-check pycolmap==4.2.1 numpy==2.4.6 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys

import pycolmap

print("pycolmap", pycolmap.__version__)
pycolmap.set_random_seed(0)
options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=8, num_points3D=200)
model = pycolmap.synthesize_dataset(options)
model.update_point_3d_errors()
before = model.compute_mean_reprojection_error()
for camera in model.cameras.values():
    camera.focal_length = 1.1 * camera.focal_length
after = model.compute_mean_reprojection_error()
model.update_point_3d_errors()
updated = model.compute_mean_reprojection_error()
print("guess: the second figure is many pixels, like the third")
print(f"as made {before:.4f} px; focal length 10 % longer {after:.4f} px; after update_point_3d_errors {updated:.4f} px")
as_described = before == after < 0.001 and updated > 5
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
