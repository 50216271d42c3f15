#!/usr/bin/env bash
# The display matrix of a video mirrors it. PyAV decodes it and says by which angle to turn it.
# Guess: VideoFrame.rotation tells apart all eight ways in which a frame can stand; a mirror is 0 degrees, or an error.
# Seen: a mirror from left to right reads as half a turn, one from top to bottom as nothing, and a quarter turn with a mirror
# as the quarter turn. Only the matrix in the frame's side data has the mirror.
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
env/bin/python -m pip install --quiet --disable-pip-version-check av==18.1.0 numpy==2.4.6 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys

import av
import numpy as np

av.logging.set_level(av.logging.ERROR)
print("PyAV", av.__version__)


def read(turn, hflip, vflip):
    with av.open("turned.mp4", "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.set_display_rotation(turn, hflip=hflip, vflip=vflip)
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((64, 96, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode())
    with av.open("turned.mp4") as container:
        frame = next(container.decode(video=0))
        data = next(bytes(item) for item in frame.side_data if item.type.name == "DISPLAYMATRIX")
    matrix = np.frombuffer(data, np.int32).reshape(3, 3)[:2, :2] / 65536
    return abs(frame.rotation), round(float(np.linalg.det(matrix)))


print("guess: the angle of a mirrored video differs from that of every plain turn, or reading it is an error")
seen = {}
for name, case in {
    "half turn": (180, False, False), "quarter turn": (90, False, False), "mirror left-right": (0, True, False),
    "mirror top-bottom": (0, False, True), "quarter turn and mirror": (90, True, False),
}.items():
    seen[name] = read(*case)
    print(f"{name}: rotation {seen[name][0]}, determinant of the matrix {seen[name][1]}")
as_described = (
    [angle for angle, _ in seen.values()] == [180, 90, 180, 0, 90]
    and [sign for _, sign in seen.values()] == [1, 1, -1, -1, -1]
)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
