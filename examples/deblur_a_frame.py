"""Remove the motion blur of a frame with a finished run.

python deblur_a_frame.py RUN FRAME OUT.png
"""

import sys

import cv2

import cleargs as cg

if len(sys.argv) != 4:
    sys.exit(__doc__)
folder, frame_id, output = sys.argv[1:]
found = cg.deblur(cg.open_run(folder), int(frame_id))
if found is None:
    print(f"no motion explains frame {frame_id} better than the sharp render")
else:
    print(f"removed: blur {found.formation.blur_px:.1f} px, skew {found.formation.skew_px:.1f} px")
    cv2.imwrite(output, cv2.cvtColor((255 * found.image).round().astype("uint8"), cv2.COLOR_RGB2BGR))
