#!/usr/bin/env bash
# An RGBA picture, such as the ones of synthetic NeRF scenes, is read with OpenImageIO and written again.
# Guess: reading gives the stored numbers, and a copy has the colours of the original.
# Seen: colours are multiplied by alpha while reading, in 8 bits. The copy's colours are off where alpha is low, and gone where
# it is 0. Only the hint oiio:UnassociatedAlpha gives the stored numbers.
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
env/bin/python -m pip install --quiet --disable-pip-version-check OpenImageIO==3.2.2.0 numpy==2.4.6 pillow==13.0.0 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys

import numpy as np
import OpenImageIO as oiio
from PIL import Image

print("OpenImageIO", oiio.__version__)
pixels = np.array([[[200, 100, 50, alpha] for alpha in (255, 128, 10, 2, 0)]], np.uint8)
Image.fromarray(pixels, "RGBA").save("picture.png")
read = oiio.ImageInput.open("picture.png").read_image("uint8")
oiio.ImageBuf("picture.png").write("copy.png")
copy = np.asarray(Image.open("copy.png"))
hint = oiio.ImageSpec()
hint.attribute("oiio:UnassociatedAlpha", 1)
asked = oiio.ImageInput.open("picture.png", hint).read_image("uint8")
print("guess: all rows equal")
for name, row in {"stored": pixels, "read": read, "copy": copy, "read with the hint": asked}.items():
    print(f"{name:18}", row.reshape(-1, 4).tolist())
as_described = bool(
    (read[0, 1, :3] < 110).all() and not read[0, 4].any() and (asked == pixels).all() and not copy[0, 4].any()
    and (copy[0, 2, :3] != pixels[0, 2, :3]).any()
)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
