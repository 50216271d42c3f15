#!/usr/bin/env bash
# A film of one colour is written with PyAV: the stream is tagged BT.709, the frames are made from RGB.
# Guess: the encoder's tag says how RGB is turned into YUV, so a player shows the colour that was written.
# Seen: PyAV converts by BT.601 whatever the tag says, and decodes by the tag: (200, 60, 30) comes back as (214, 72, 27).
# Without a tag, or with the frame converted to BT.709 explicitly, it comes back.
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
from av.video.reformatter import Colorspace, ColorRange

av.logging.set_level(av.logging.ERROR)
print("PyAV", av.__version__, "with libavcodec", ".".join(map(str, av.library_versions["libavcodec"])))
BT709, LIMITED = 1, 1
COLOUR = (200, 60, 30)


def film(tagged, explicit):
    with av.open("film.mp4", "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "0"})
        stream.width, stream.height, stream.pix_fmt = 128, 128, "yuv444p"
        if tagged:
            context = stream.codec_context
            context.colorspace = context.color_primaries = context.color_trc = BT709
            context.color_range = LIMITED
        for _ in range(3):
            frame = av.VideoFrame.from_ndarray(np.full((128, 128, 3), COLOUR, np.uint8), format="rgb24")
            if explicit:
                frame = frame.reformat(
                    format="yuv444p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
                )
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with av.open("film.mp4") as container:
        frame = next(container.decode(video=0))
        return frame.to_ndarray(format="rgb24")[64, 64].astype(int)


print(f"guess: {COLOUR} in all cases, to 2 codes")
seen = {"no tag": film(False, False), "tag BT.709": film(True, False), "tag and explicit": film(True, True)}
for name, colour in seen.items():
    print(f"{name}: {tuple(colour.tolist())}")
off = {name: np.abs(colour - COLOUR).max() for name, colour in seen.items()}
as_described = bool(off["no tag"] <= 2 and off["tag BT.709"] > 8 and off["tag and explicit"] <= 2)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
