#!/usr/bin/env bash
# A linear EXR image with values up to 4 is read by imageio with its plug-in PyAV installed.
# Guess: an array of floats, or an error.
# Seen: 8-bit codes of shape (1, height, width, 3), as of a video: everything above 1 is cut off, without a warning.
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
env/bin/python -m pip install --quiet --disable-pip-version-check imageio==2.38.1 av==18.1.0 OpenEXR==3.5.3 numpy==2.4.6 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys
import warnings

import imageio
import imageio.v3 as iio
import numpy as np
import OpenEXR

print("imageio", imageio.__version__)
pixels = np.full((32, 48, 3), (0.25, 1.0, 4.0), np.float32)
header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
OpenEXR.File(header, {"RGB": pixels}).write("linear.exr")
print("guess: float values 0.25, 1, 4, or an error")
with warnings.catch_warnings(record=True) as warned:
    warnings.simplefilter("always")
    read = iio.imread("linear.exr")
print(f"{read.dtype}, shape {read.shape}, pixel {read.reshape(-1, 3)[0].tolist()}, warnings: {len(warned)}")
print("by OpenEXR itself:", OpenEXR.File("linear.exr").channels()["RGB"].pixels[0, 0].tolist())
as_described = read.dtype == np.uint8 and read.shape == (1, 32, 48, 3) and read.max() == 255 and not warned
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
