#!/usr/bin/env bash
# A camera model for fisheye lenses, asked for the direction of a pixel that looks sideways or back.
# Guess: no result (NaN, None), or a direction with z <= 0; the method for omnidirectional cameras gives the true one.
# Seen: a finite direction to the front, 50 degrees and more away from the true one.
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

FOCAL = 320.0  # no distortion: the angle off the axis is the distance from the centre / FOCAL
print("pycolmap", pycolmap.__version__)
camera = pycolmap.Camera(
    model="OPENCV_FISHEYE", width=1000, height=1000, params=[FOCAL, FOCAL, 500, 500, 0, 0, 0, 0]
)
pixels = np.array([[400.0, 400.0], [100.0, 100.0], [30.0, 30.0]])
true = np.degrees(np.linalg.norm(pixels - 500, axis=1) / FOCAL)
flat = np.array(camera.cam_from_img(pixels))
rays = np.array(camera.cam_ray_from_img(pixels))
by_flat = np.degrees(np.arctan(np.linalg.norm(flat, axis=1)))
by_ray = np.degrees(np.arccos(rays[:, 2] / np.linalg.norm(rays, axis=1)))
back = np.array(camera.img_from_cam(np.c_[flat, np.ones(3)]))
print("guess: behind the camera cam_from_img gives NaN or None, and cam_ray_from_img a ray with z < 0")
for k in range(3):
    print(
        f"pixel {pixels[k]}: {true[k]:.1f} degrees off the axis; cam_from_img {by_flat[k]:.1f},"
        f" cam_ray_from_img {by_ray[k]:.1f}; projected again at {np.round(back[k])}"
    )
front_right = abs(by_flat[0] - true[0]) < 0.01 and abs(by_ray[0] - true[0]) < 0.01
wrong = np.isfinite(flat).all() and (by_flat[1:] < 90).all() and (true[1:] > 90).all() and (by_ray[1:] < 90).all()
as_described = bool(front_right and wrong and (np.abs(back - pixels)[1:] > 100).all())
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
