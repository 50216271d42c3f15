"""A scene: Gaussians and their rendering options, as ``scene.ply`` stores them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from cleargs.splat.gaussians import Gaussians

Colour = tuple[float, float, float]
"""sRGB in [0, 1]."""

BLACK: Colour = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians in the normalised world of ``ingest``, with their rendering options."""

    gaussians: Gaussians
    antialias: bool = False
    """True: the opacities of splats smaller than a pixel are compensated (Mip-Splatting)."""
    background: Colour = BLACK
    """Colour of the background."""

    def to(self, device: torch.device | str) -> Scene:
        """Return the scene with its Gaussians on a device."""
        return replace(self, gaussians=self.gaussians.to(device))
