#!/usr/bin/env bash
# A scene is converted to a compressed PLY or SOG file and back, to compare each Gaussian with its original.
# Guess: the n-th Gaussian of the copy is the n-th of the original, as in a copy as PLY or SPZ.
# Seen: these two formats store Gaussians in the order of a Morton curve, and nothing in the file tells the old order; tables
# by number (labels, times, weights) no longer fit.
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

from scene import convert, make, read

make(500, 0.1)
first = read("scene.ply")["x"]
seen = {}
print("guess: all 500 in place in all formats")
for ending in (".ply", ".spz", ".compressed.ply", ".sog"):
    back = convert("scene.ply", "scene_2" + ending, "back.ply")["x"]
    kept = sum(abs(a - b) < 0.01 for a, b in zip(first, back))
    same_set = all(abs(a - b) < 0.05 for a, b in zip(sorted(first), sorted(back)))
    seen[ending] = kept, same_set
    print(f"{ending}: {kept} of {len(back)} in place; the same Gaussians in some order: {same_set}")
as_described = all(same for _, same in seen.values()) and (
    seen[".ply"][0] == seen[".spz"][0] == 500 and max(seen[".compressed.ply"][0], seen[".sog"][0]) < 100
)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
