#!/usr/bin/env bash
# A photograph was reduced to a quarter of its width, and its EXIF data were kept. COLMAP reads its focal length.
# Guess: the focal length in pixels follows the size of the picture, as with the tag FocalLengthIn35mmFilm.
# Seen: with FocalPlaneXResolution it is that of the full picture, so it is 4 times too long, and it is marked as known.
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
env/bin/python -m pip install --quiet --disable-pip-version-check pycolmap==4.2.1 numpy==2.4.6 pillow==13.0.0 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys

import numpy as np
import pycolmap
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

EXIF_IFD, FOCAL, IN_35MM, X_RESOLUTION, UNIT, WIDTH, HEIGHT = 34665, 37386, 41989, 41486, 41488, 40962, 40963
print("pycolmap", pycolmap.__version__)
picture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8))


def focal(reduced: int, in_35mm: bool) -> pycolmap.Camera:
    # A lens of 24 mm before a sensor of 36 mm, whose full picture has 320 * reduced pixels a row.
    exif = Image.Exif()
    tags = exif.get_ifd(EXIF_IFD)
    tags[FOCAL] = IFDRational(24)
    tags[WIDTH], tags[HEIGHT] = 320 * reduced, 240 * reduced
    if in_35mm:
        tags[IN_35MM] = 24
    else:
        tags[X_RESOLUTION], tags[UNIT] = IFDRational(round(320 * reduced * 25.4 / 36 * 1000), 1000), 2
    picture.save("photo.jpg", exif=exif)
    return pycolmap.infer_camera_from_image("photo.jpg")


true = 320 * 24 / 36
print(f"guess: about {true:.1f} px in all cases")
seen = {}
for in_35mm in (True, False):
    for reduced in (1, 4):
        camera = focal(reduced, in_35mm)
        seen[in_35mm, reduced] = camera.mean_focal_length() / true
        tag = "FocalLengthIn35mmFilm" if in_35mm else "FocalPlaneXResolution"
        print(
            f"{tag}, 320 px wide, reduced {reduced} times: {camera.mean_focal_length():.1f} px,"
            f" known in advance: {camera.has_prior_focal_length}"
        )
as_described = abs(seen[True, 4] - seen[True, 1]) < 0.01 and abs(seen[False, 1] - 1) < 0.01 and abs(seen[False, 4] - 4) < 0.01
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
