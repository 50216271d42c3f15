"""A scene: Gaussians and their rendering options, as ``scene.ply`` stores them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from cleargs.splat.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians in the normalised world of ``ingest``, with their rendering options."""

    gaussians: Gaussians
    antialias: bool = False
    """True: the opacities of splats smaller than a pixel are compensated (Mip-Splatting)."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour of the background, sRGB in [0, 1]."""

    def to(self, device: torch.device | str) -> Scene:
        """Return the scene with its Gaussians on a device."""
        return replace(self, gaussians=self.gaussians.to(device))
