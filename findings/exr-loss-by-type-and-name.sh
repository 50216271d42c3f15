#!/usr/bin/env bash
# Which OpenEXR compressions lose something? The same numbers are written in float and in half, under several channel names.
# Guess: a compression is lossless or lossy; the name of a channel says nothing.
# Seen: it depends on the type and on the name. PXR24 loses in float and keeps half; B44 loses in half and keeps float; DWAA
# loses in both, but only in channels whose name ends in R, G or B: a depth map survives as Z, not as depth.R.
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
env/bin/python -m pip install --quiet --disable-pip-version-check OpenImageIO==3.2.2.0 numpy==2.4.6 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys

import numpy as np
import OpenImageIO as oiio

print("OpenImageIO", oiio.__version__)
NAMES = ("R", "G", "B", "Z", "depth.R", "depth.V")
values = (4 * np.random.default_rng(0).random((64, 64))).astype(np.float32)


def largest_errors(compression, kind):
    spec = oiio.ImageSpec(64, 64, len(NAMES), kind)
    spec.channelnames = NAMES
    spec.attribute("compression", compression)
    output = oiio.ImageOutput.create("values.exr")
    output.open("values.exr", spec)
    output.write_image(np.repeat(values[..., None], len(NAMES), axis=2))
    output.close()
    image = oiio.ImageInput.open("values.exr")
    pixels, names = image.read_image("float"), image.spec().channelnames
    image.close()
    true = values.astype(np.float16) if kind == "half" else values
    return {name: float(np.abs(pixels[..., names.index(name)] - true).max()) for name in NAMES}


print("guess: one column of zeros or none for each compression")
seen = {}
for compression in ("zip", "piz", "pxr24", "b44", "dwaa"):
    for kind in ("float", "half"):
        seen[compression, kind] = largest_errors(compression, kind)
        print(f"{compression:5} {kind:5}", "  ".join(f"{k} {v:.6f}" for k, v in seen[compression, kind].items()))
lossy = {key: {name for name, error in errors.items() if error > 0} for key, errors in seen.items()}
by_name = {"R", "G", "B", "depth.R"}
as_described = lossy == {
    ("zip", "float"): set(), ("zip", "half"): set(), ("piz", "float"): set(), ("piz", "half"): set(),
    ("pxr24", "float"): set(NAMES), ("pxr24", "half"): set(), ("b44", "float"): set(), ("b44", "half"): set(NAMES),
    ("dwaa", "float"): by_name, ("dwaa", "half"): by_name,
}
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
