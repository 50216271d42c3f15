"""``preview.png`` beside a checkpoint: the scene so far, for whoever watches a training."""

from __future__ import annotations

from pathlib import Path

import cv2
from torch import Tensor

from cleargs.files import write_bytes
from cleargs.splat.camera import Camera

_SIDE = 640  # px, the longer one at most


def preview_camera(camera: Camera) -> Camera:
    """``camera`` reduced to the size of a preview."""
    return camera.scaled(min(1.0, _SIDE / max(camera.width, camera.height)))


def write_preview(path: Path, image: Tensor) -> None:  # [H, W, 3] sRGB
    """Write ``image`` atomically as a PNG, its values clipped to [0, 1]."""
    levels = (image.clamp(0.0, 1.0) * 255.0).round().byte().cpu().numpy()
    _, data = cv2.imencode(".png", cv2.cvtColor(levels, cv2.COLOR_RGB2BGR))
    write_bytes(path, data.tobytes())
