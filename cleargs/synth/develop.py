"""From light to files: the sensor, and the folders of a capture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cleargs.files import write_json
from cleargs.media.colour import srgb_from_linear
from cleargs.parquet import column
from cleargs.synth.optics import Array, Lens
from cleargs.synth.phone import PLAIN, Look

FRAMES = pa.schema(
    [
        column("frame_id", pa.int32(), "number of the frame, as in images/"),
        column("image", pa.string(), "file below the capture"),
        column("time_s", pa.float64(), "middle of the exposure, of the middle row, seconds"),
        column("blur_px", pa.float64(), "mean length of the motion path in the image, pixels"),
        column("defocus_px", pa.float64(), "mean radius of the blur disc, pixels"),
        column("exposure_ev", pa.float64(), "exposure error, stops"),
        column("noise", pa.float64(), "deviation of the sensor noise at mid grey, sRGB units"),
        column(
            "rolling_shutter_px", pa.float64(), "mean distance in the image between first and last row's pose"
        ),
        column("exposure_s", pa.float64(), "time that the shutter is open for a row, seconds; 0: an instant"),
        column("readout_s", pa.float64(), "time from first to last row, seconds; 0: global shutter"),
        column("shutter_share", pa.float64(), "exposure_s over the time from frame to frame"),
        column("tone_contrast", pa.float64(), "contrast of the tone curve, as in phone.Look; 0: none"),
        column("tone_pivot", pa.float64(), "its pivot, sRGB in [0, 1]"),
        column("sharpening", pa.float64(), "share of the fine detail that is added; 0: none"),
        column("codec_bits_per_pixel", pa.float64(), "stated rate of the H.264 coding; 0: not coded"),
        column("moving_share", pa.float64(), "share of the pixels that see what moves; 0: nothing does"),
    ]
)
"""``truth/frames.parquet``; pixels are those of the capture's own images."""


def develop(
    image: Array,
    *,
    stops: float = 0.0,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
    look: Look = PLAIN,
) -> NDArray[np.uint8]:
    """Exposure error, sensor noise, clipping, sRGB encoding, the camera's look, 8 bits: RGB [H, W, 3] from
    linear light.

    The noise is signal-dependent: ``noise`` is its deviation in sRGB units at mid grey of a frame exposed
    by ``stops``, of whose square 70 % is shot noise and the rest is read noise.
    """
    image = image * 2.0**stops
    if rng is not None:
        mid_grey_slope = 0.6  # d linear / d sRGB at mid grey: carries the stated deviation into linear light
        shape = np.sqrt(np.clip(image, 0, None) / 0.2 * 0.7 + 0.3)
        image = image + rng.standard_normal(image.shape) * noise * mid_grey_slope * shape
    return np.asarray(np.rint(look.apply(srgb_from_linear(np.clip(image, 0, 1))) * 255), np.uint8)


def write_transforms(folder: Path, lens: Lens, images: Sequence[str], poses: Array) -> None:  # [F, 3, 4]
    """``transforms.json`` as nerfstudio reads it: OpenGL camera to world."""
    frames = []
    for image, pose in zip(images, poses, strict=True):
        matrix = np.vstack([pose, [0, 0, 0, 1]]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": image, "transform_matrix": matrix.tolist()})
    camera = {"camera_model": "OPENCV", "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    write_json(folder / "transforms.json", {**camera, "w": lens.width, "h": lens.height, "frames": frames})
