#!/usr/bin/env bash
# The relative pose of two views of a flat wall, from 300 matches without noise.
# Guess: the right rotation, and the right direction as a translation of length 1, as for every other pair.
# Seen: the length is that of the path divided by the distance of the wall, and a walk towards a slanted wall gives
# another pose, which explains the matches of a plane as well: 6 degrees off in rotation, 30 in direction.
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
camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[600, 600, 320, 240])
camera.has_prior_focal_length = True
options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)
random = np.random.default_rng(0)
wide = random.uniform(-2, 2, (300, 2))


def pixels(points, rotation, translation):
    there = points @ rotation.T + translation
    return there[:, :2] / there[:, 2:] * 600 + [320, 240]


def relative_pose(depth, rotation, translation):
    points = np.c_[wide, depth]
    one, two = pixels(points, np.eye(3), np.zeros(3)), pixels(points, rotation, translation)
    pairs = np.c_[np.arange(300), np.arange(300)].astype(np.uint32)
    found = pycolmap.estimate_two_view_geometry(camera, one, camera, two, pairs, options)
    pose = found.cam2_from_cam1
    length = np.linalg.norm(pose.translation)
    cosine = pose.translation @ translation / length / np.linalg.norm(translation)
    direction = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    turn = np.degrees((pose.rotation * pycolmap.Rotation3d(rotation).inverse()).angle())
    kind = pycolmap.TwoViewGeometryConfiguration(found.config).name
    print(f"  {kind}: length {length:.4f}, rotation off by {turn:.2f}, direction by {direction:.2f} degrees")
    return length, turn, direction


sideways = np.array([-0.5, 0.1, 0.2])
angle = 0.1
turned = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
print("guess: length 1, rotation and direction right")
print("points in a volume, sideways:")
volume = relative_pose(random.uniform(4, 8, 300), turned, sideways)
print(f"a wall 5 units away, sideways by {np.linalg.norm(sideways):.4f} (a fifth of it is {np.linalg.norm(sideways) / 5:.4f}):")
wall = relative_pose(np.full(300, 5.0), turned, sideways)
print("a slanted wall, one unit towards it:")
slanted = relative_pose(5 + 0.5 * wide[:, 0], np.eye(3), np.array([0.0, 0.0, -1.0]))
as_described = (
    abs(volume[0] - 1) < 1e-6 and max(volume[1:]) < 0.1
    and abs(wall[0] - np.linalg.norm(sideways) / 5) < 1e-3 and max(wall[1:]) < 0.1
    and slanted[1] > 3 and slanted[2] > 15
)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
