#!/usr/bin/env bash
# libultrahdr, the reference encoder of Ultra HDR photographs (here from imagecodecs), writes the ICC profile of the base picture.
# Guess: a profile whose name has "sRGB" in it is sRGB, so its codes can be taken as they are; a picture declared as BT.709 gets one.
# Seen: whatever gamut is declared, the profile is "Display P3 Gamut with sRGB Transfer", with the red of Display P3: taken as
# sRGB, the colours are off.
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
env/bin/python -m pip install --quiet --disable-pip-version-check imagecodecs==2026.3.6 pillow==13.0.0 numpy==2.4.6 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import io
import sys

import imagecodecs
import numpy as np
from PIL import Image, ImageCms

print(imagecodecs.ultrahdr_version(), "in imagecodecs", imagecodecs.__version__)
picture = np.zeros((64, 64, 4), np.float16)
picture[...] = (0.4, 0.05, 0.05, 1)
gamuts = imagecodecs.ULTRAHDR.CG
print("guess: one profile for each gamut, and only that of BT.709 has sRGB in its name")
seen = []
for gamut in (gamuts.BT_709, gamuts.DISPLAY_P3, gamuts.BT_2100):
    encoded = imagecodecs.ultrahdr_encode(picture, gamut=gamut, transfer=imagecodecs.ULTRAHDR.CT.LINEAR)
    image = Image.open(io.BytesIO(encoded))
    profile = ImageCms.ImageCmsProfile(io.BytesIO(image.info["icc_profile"]))
    name, red = profile.profile.profile_description, profile.profile.red_colorant[1][:2]
    seen.append((name, red))
    srgb = ImageCms.profileToProfile(image, profile, ImageCms.createProfile("sRGB"))
    print(f"{gamut.name}: {name!r}, red at {red[0]:.3f}, {red[1]:.3f}; codes {image.getpixel((32, 32))}, as sRGB {srgb.getpixel((32, 32))}")
as_described = all("sRGB" in name and abs(red[0] - 0.68) < 0.01 for name, red in seen)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
