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

    def to_gsplat(self) -> dict[str, torch.Tensor]:
        """Return the arguments of ``gsplat.rasterization``: ``means``, ``quats``, ``scales``, ... ``colors``.

        Scales and opacities are activated. ``colors`` are SH coefficients [N, K, 3] for ``sh_degree``.

        Example:
            arguments = cg.open_run("run").scene().to_gsplat()
            scene = cg.Scene.from_gsplat(**arguments)
        """
        found = self.gaussians
        return {
            "means": found.means,
            "quats": torch.nn.functional.normalize(found.rotations, dim=1),
            "scales": found.log_scales.exp(),
            "opacities": torch.sigmoid(found.logit_opacities),
            "colors": found.sh,
        }

    @classmethod
    def from_gsplat(
        cls,
        means: torch.Tensor,  # [N, 3]
        quats: torch.Tensor,  # [N, 4] w x y z
        scales: torch.Tensor,  # [N, 3]
        opacities: torch.Tensor,  # [N] in (0, 1)
        colors: torch.Tensor,  # [N, K, 3]
    ) -> Scene:
        """Return a scene of the arguments of ``gsplat.rasterization``; the inverse of `to_gsplat`."""
        return cls(Gaussians(means, scales.log(), quats, torch.logit(opacities, eps=1e-6), colors))

    def __repr__(self) -> str:
        found = self.gaussians
        return f"<Scene of {found.num} Gaussians, SH degree {found.sh_degree}, on {found.device}>"
