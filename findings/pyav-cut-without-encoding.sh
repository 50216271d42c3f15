#!/usr/bin/env bash
# A clip is cut out of an MP4 without encoding it again: the file keeps the frames from the last key frame on and hides
# those before the cut by an edit list. PyAV (FFmpeg) reads it.
# Guess: the number of frames in the stream's header is the number that can be decoded, or start_time < 0 tells of the rest.
# Seen: start_time is 0, stream.frames counts the hidden frames, and 6 of 30 never come; the duration is right. A program that
# compares the numbers takes the file for damaged.
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
print("PyAV", av.__version__, "with libavformat", ".".join(map(str, av.library_versions["libavformat"])))
with av.open("whole.mp4", "w") as container:
    stream = container.add_stream("libx264", rate=10, options={"g": "10", "bf": "0"})
    stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
    for k in range(40):
        frame = av.VideoFrame.from_ndarray(np.full((64, 64, 3), 20 + 5 * k, np.uint8), format="rgb24")
        container.mux(stream.encode(frame))
    container.mux(stream.encode())
with av.open("whole.mp4") as source, av.open("cut.mp4", "w") as target:
    read = source.streams.video[0]
    write = target.add_stream_from_template(read)
    start = int(1.55 / read.time_base)
    source.seek(start, stream=read)  # to the key frame before
    for packet in source.demux(read):
        if packet.dts is not None:
            packet.pts, packet.dts, packet.stream = packet.pts - start, packet.dts - start, write
            target.mux(packet)


def look(path):
    with av.open(path) as container:
        stream = container.streams.video[0]
        decoded = sum(1 for _ in container.decode(stream))
        seconds = float(stream.duration * stream.time_base)
        print(f"{path}: header {stream.frames} frames, start_time {stream.start_time}, {seconds:.2f} s; decoded {decoded}")
        return stream.frames, stream.start_time, decoded, seconds


print("guess: header and decoded agree, or start_time is below 0")
whole, cut = look("whole.mp4"), look("cut.mp4")
as_described = whole[0] == whole[2] == 40 and cut[0] == 30 and cut[1] == 0 and cut[2] < 26 and abs(cut[3] - 2.45) < 0.02
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
