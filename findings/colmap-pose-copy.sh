#!/usr/bin/env bash
# The translation of a pose of a model is set.
# Guess: it works for the pose of an image as it does for the pose of its frame.
# Seen: frame.rig_from_world is the model's own pose; image.cam_from_world() is a copy, so its change is lost silently.
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

import numpy as np
import pycolmap

print("pycolmap", pycolmap.__version__)
pycolmap.set_random_seed(0)
options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=3, num_points3D=20)
model = pycolmap.synthesize_dataset(options)
image = next(iter(model.images.values()))
start = image.projection_center().copy()
image.cam_from_world().translation = image.cam_from_world().translation + 1
by_image = np.linalg.norm(image.projection_center() - start)
image.frame.rig_from_world.translation = image.frame.rig_from_world.translation + 1
by_frame = np.linalg.norm(image.projection_center() - start)
print("guess: both moved the camera by 1.732")
print(f"camera moved by image.cam_from_world(): {by_image:.3f}; by image.frame.rig_from_world: {by_frame:.3f}")
as_described = by_image == 0 and abs(by_frame - 3**0.5) < 1e-6
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
