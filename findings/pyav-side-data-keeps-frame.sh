#!/usr/bin/env bash
# 300 frames of a video are decoded with PyAV, one after the other, and each is asked for its rotation: the property
# `rotation`, or the display matrix in `side_data`, which also tells mirroring.
# Guess: a frame is freed when the next one takes its name.
# Seen: with `side_data` a frame lives until Python's garbage collector looks for cycles; dozens to hundreds fill the memory.
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
import gc
import sys
from pathlib import Path

import av
import numpy as np

with av.open("clip.mp4", "w") as clip:
    stream = clip.add_stream("mpeg4", rate=30)
    stream.width, stream.height, stream.pix_fmt = 1280, 720, "yuv420p"
    for number in range(300):
        picture = np.full((720, 1280, 3), number % 256, np.uint8)
        clip.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
    clip.mux(stream.encode(None))


def memory():
    """Return the resident memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def most_frames(ask):
    """Return the largest number of frames that live at a time, and the growth of the memory in MB."""
    gc.collect()
    before, most, grown = memory(), 0, 0.0
    with av.open("clip.mp4") as clip:
        for number, frame in enumerate(clip.decode(video=0)):
            ask(frame)
            if number % 20 == 19:
                most = max(most, sum(isinstance(thing, av.VideoFrame) for thing in gc.get_objects()))
                grown = max(grown, memory() - before)
    return most, grown


print("guess: one or two frames in both cases")
plain, small = most_frames(lambda frame: frame.rotation)
side, large = most_frames(lambda frame: frame.side_data.get("DISPLAYMATRIX"))
print(f"PyAV {av.__version__}: rotation {plain} frame(s), {small:.0f} MB; side_data {side} frames, {large:.0f} MB")
as_described = plain <= 2 and side >= 20
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
