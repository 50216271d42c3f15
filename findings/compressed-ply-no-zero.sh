#!/usr/bin/env bash
# A scene whose harmonics are all 0 goes through the compressed PLY of PlayCanvas and back.
# Guess: 0 stays 0; at least it becomes a little positive for some coefficients and negative for others.
# Seen: every coefficient comes back as +1/64, because the 256 levels lie on both sides of 0 and none on it. Padding a scene with
# zeros up to a higher degree therefore adds a colour that depends on the direction. SPZ of the same tool keeps 0.
# Exit: 0 as described, 1 changed, 2 cannot be tried here.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cannot() {
  echo "cannot be tried here: $1"
  exit 2
}
cd "$work"
command -v npm >/dev/null || cannot "npm is missing"
command -v python3 >/dev/null || cannot "python3 is missing"
npm install --ignore-scripts --silent --no-fund --no-audit @playcanvas/splat-transform@3.7.0 ||
  cannot "the package could not be installed"
cat >scene.py <<'EOF'
import random
import struct
import subprocess

REST = [f"f_rest_{k}" for k in range(9)]
NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *REST, "opacity", "scale_0", "scale_1", "scale_2"]
NAMES += ["rot_0", "rot_1", "rot_2", "rot_3"]


def make(count, harmonics):
    # Gaussians of degree 1; harmonics is the standard deviation of their coefficients.
    draw = random.Random(1)
    rows = []
    for _ in range(count):
        rest = [draw.gauss(0, harmonics) if harmonics else 0.0 for _ in REST]
        rows.append([draw.gauss(0, 1) for _ in range(6)] + rest + [draw.gauss(0, 1), -4, -4.5, -5, 1, 0, 0, 0])
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in NAMES] + ["end_header", ""]
    with open("scene.ply", "wb") as file:
        file.write("\n".join(header).encode())
        for row in rows:
            file.write(struct.pack(f"<{len(row)}f", *row))


def read(path):
    # Columns of a PLY of floats by name.
    header, body = open(path, "rb").read().split(b"end_header\n", 1)
    names = [line.split()[2].decode() for line in header.splitlines() if line.startswith(b"property float")]
    numbers = struct.unpack(f"<{len(body) // 4}f", body)
    return {name: numbers[k :: len(names)] for k, name in enumerate(names)}


def convert(*paths):
    for source, target in zip(paths, paths[1:]):
        subprocess.run(["node_modules/.bin/splat-transform", "-q", "-w", "-g", "cpu", source, target], check=True)
    return read(paths[-1])
EOF
echo "@playcanvas/splat-transform 3.7.0, node $(node --version)"
python3 - <<'EOF'
import sys

from scene import REST, convert, make

make(200, 0)
seen = {}
print("guess: 0 in both formats")
for ending in (".compressed.ply", ".spz"):
    back = convert("scene.ply", "scene" + ending, "back.ply")
    seen[ending] = sorted({value for name in REST for value in back.get(name, [0.0])})
    print(f"{ending}: coefficients {seen[ending]}")
as_described = seen == {".compressed.ply": [1 / 64], ".spz": [0.0]}
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
