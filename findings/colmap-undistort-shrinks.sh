#!/usr/bin/env bash
# Undistortion of a camera that has no distortion, without blank pixels.
# Guess: the same size and the same camera, whatever the name of the model.
# Seen: PINHOLE stays; SIMPLE_RADIAL and OPENCV with all terms 0 lose a row and a column, and the centre moves. With a
# maximum size of 333 px the same lens gets a focal length that is 0.3 % longer for its width.
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
options = pycolmap.UndistortCameraOptions(blank_pixels=0.0)
small = pycolmap.UndistortCameraOptions(blank_pixels=0.0, max_image_size=333)
cameras = {
    "PINHOLE": [600, 600, 300, 250],
    "SIMPLE_RADIAL": [600, 300, 250, 0.0],
    "OPENCV": [600, 600, 300, 250, 0.0, 0.0, 0.0, 0.0],
}
print("guess: 640x480, centre 300.00, 250.00 for all three")
seen = {}
for model, params in cameras.items():
    camera = pycolmap.Camera(model=model, width=640, height=480, params=params)
    flat, reduced = pycolmap.undistort_camera(options, camera), pycolmap.undistort_camera(small, camera)
    seen[model] = flat.width, flat.height
    print(
        f"{model}: {flat.width}x{flat.height}, centre {flat.principal_point_x:.2f}, {flat.principal_point_y:.2f};"
        f" reduced to {reduced.width}x{reduced.height}: focal length / width {reduced.focal_length_x / reduced.width:.5f}"
        f" (true {600 / 640:.5f})"
    )
as_described = seen["PINHOLE"] == (640, 480) and seen["SIMPLE_RADIAL"] != (640, 480) != seen["OPENCV"]
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
