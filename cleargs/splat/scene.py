"""A scene: Gaussians and how they are meant to be rendered, exactly what a ``scene.ply`` says."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from cleargs.splat.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians in the normalised world of ``ingest``, with their rendering options."""

    gaussians: Gaussians
    antialias: bool = False
    """Whether opacities of sub-pixel splats are compensated (Mip-Splatting)."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """sRGB behind everything, in [0, 1]."""

    def to(self, device: torch.device | str) -> Scene:
        """The same scene with its Gaussians on another device."""
        return replace(self, gaussians=self.gaussians.to(device))
