"""Score the frames in a folder and restore the worst one.

python rate_frames.py FOLDER OUT.png
"""

import sys
from pathlib import Path

import cv2

import cleargs as cg

if len(sys.argv) != 3:
    sys.exit(__doc__)
folder, output = sys.argv[1:]
frames = sorted(path for path in Path(folder).iterdir() if path.suffix in (".png", ".jpg"))
table = cg.score_frames(frames)
for path, R, B in zip(frames, table["R"].to_pylist(), table["B"].to_pylist(), strict=True):
    print(f"{path.name}: reliability {R:.2f}, degradation {B:.2f}")

worst = frames[table["R"].to_pylist().index(min(table["R"].to_pylist()))]
image = cv2.imread(str(worst), cv2.IMREAD_COLOR_RGB)
restored = cg.restore(image)  # [H, W, 3] float32 sRGB
print(f"{worst.name}: clarity {cg.score(image):.1f}, restored {cg.score(restored):.1f}")
cv2.imwrite(output, cv2.cvtColor((255 * restored).round().astype("uint8"), cv2.COLOR_RGB2BGR))
