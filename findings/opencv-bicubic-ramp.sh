#!/usr/bin/env bash
# A picture of an even ramp (each pixel 10 more than the one on its left) is moved by a part of a pixel with the bicubic filter.
# Guess: every bicubic filter keeps a ramp, so it moves by exactly that part.
# Seen: Pillow does so for enlargements; OpenCV's filter (a = -0.75 instead of -0.5) is off by up to 0.05 px: it moves
# the ramp by 0.136 px where 0.1 were asked for.
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
  numpy==2.4.6 opencv-python-headless==5.0.0.93 pillow==13.0.0 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys

import cv2
import numpy as np
import PIL
from PIL import Image

print("OpenCV", cv2.__version__, "Pillow", PIL.__version__)
ramp = np.tile(np.arange(64, dtype=np.float32) * 10, (16, 1))
parts = np.arange(0, 1.001, 0.05)
x, y = np.meshgrid(20 + parts, [8.0])
moved = cv2.remap(ramp, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC)[0] / 10 - 20
linear = cv2.remap(ramp, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)[0] / 10 - 20
print("guess: asked for and seen are equal")
for k in (0, 2, 5, 10, 15, 18):
    print(f"asked for {parts[k]:.2f} px: bicubic {moved[k]:.4f}, linear {linear[k]:.4f}")
middle = slice(80, 176)
true = (np.arange(256) + 0.5) / 4 * 10 - 5
by_opencv = cv2.resize(ramp, (256, 64), interpolation=cv2.INTER_CUBIC)[32] - true
by_pillow = np.asarray(Image.fromarray(ramp).resize((256, 64), Image.Resampling.BICUBIC))[32] - true
opencv, pillow = np.abs(by_opencv[middle]).max() / 10, np.abs(by_pillow[middle]).max() / 10
print(f"enlarged four times, largest error of position: OpenCV {opencv:.4f} px, Pillow {pillow:.4f} px")
as_described = bool(
    0.03 < np.abs(moved - parts).max() < 0.08 and np.abs(linear - parts).max() < 1e-3 and opencv > 0.02 and pillow < 1e-3
)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
