"""Pictures of one scene, without gradients."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cleargs.media.image import to_uint8
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.scene import Scene
from cleargs.splat.types import Render
from cleargs.types import ImageU8


class Viewer:
    """Renders one scene."""

    def __init__(self, scene: Scene, device: str = "cpu") -> None:
        self._scene = scene.to(device)
        self._engine = rasteriser_for(device)

    def view(self, camera: Camera, affine: NDArray[np.float64] | None = None) -> ImageU8:  # [H, W, 3] sRGB
        """What ``camera`` sees, its colours through ``affine`` [3, 4] if there is one."""
        image = self.render(camera, self._scene.background).image.cpu().numpy()
        if affine is not None:
            image = image @ affine[:, :3].T.astype(np.float32) + affine[:, 3].astype(np.float32)
        return to_uint8(image)

    def render(self, camera: Camera, background: tuple[float, float, float], depth: bool = False) -> Render:
        """Image, alpha and, where it is asked for, accumulated depth over ``background``."""
        scene = self._scene
        return self._engine.forward(
            scene.gaussians, camera, background=background, antialias=scene.antialias, depth=depth
        )
