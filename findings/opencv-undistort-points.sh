#!/usr/bin/env bash
# Points near the corner of a wide lens (k1 = -0.35) are undistorted and distorted again.
# Guess: they come back exactly.
# Seen: cv2.undistortPoints stops after 5 steps: the points come back 0.1 px off. With 100 steps they come back to 1e-12 px.
# COLMAP's cam_from_img is exact without an option.
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
env/bin/python -m pip install --quiet --disable-pip-version-check \
  pycolmap==4.2.1 numpy==2.4.6 opencv-python-headless==5.0.0.93 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys

import cv2
import numpy as np
import pycolmap

print("OpenCV", cv2.__version__, "pycolmap", pycolmap.__version__)
matrix = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
terms = np.array([-0.35, 0.12, 0, 0])
points = np.array([[[5.0, 5.0]], [[320.0, 5.0]], [[600.0, 400.0]]])


def again(flat):
    rays = np.c_[flat.reshape(-1, 2), np.ones(len(points))]
    there = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, terms)[0]
    return np.abs(there - points).max(axis=(1, 2))


by_default = again(cv2.undistortPoints(points, matrix, terms))
steps = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
by_100 = again(cv2.undistortPoints(points, matrix, terms, criteria=steps))
camera = pycolmap.Camera(model="OPENCV", width=640, height=480, params=[500, 500, 320, 240, *terms])
by_colmap = again(np.array(camera.cam_from_img(points[:, 0])))
print("guess: 0 px for all")
print(f"default {np.round(by_default, 4)} px, 100 steps {by_100.max():.1e} px, COLMAP {by_colmap.max():.1e} px")
as_described = bool(by_default.max() > 0.02 and by_100.max() < 1e-6 and by_colmap.max() < 1e-6)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
