"""The scene: raw (pre-activation) parameters of N anisotropic Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from cleargs.errors import InputError
from cleargs.splat.constants import SH_DEGREES


@dataclass
class Gaussians:
    """Parameters of N Gaussians as the optimiser sees them, in the layout of Inria's PLY.

    The covariance is R diag(exp(2 log_scales)) Rᵀ with R from the normalised quaternion, the opacity
    is sigmoid(logit_opacities), the colour in sRGB is max(SH(direction) + 0.5, 0). K, the number of
    stored SH coefficients, is 1, 4, 9 or 16 (degree 0 to 3).

    The same class holds the gradients of a loss with respect to these parameters.

    Raises:
        InputError: when the shapes do not belong together.
    """

    means: Tensor  # [N, 3] world units
    log_scales: Tensor  # [N, 3] natural logarithm of the standard deviations in world units
    rotations: Tensor  # [N, 4] quaternions w x y z, need not be normalised
    logit_opacities: Tensor  # [N]
    sh: Tensor  # [N, K, 3]

    def __post_init__(self) -> None:
        n = self.means.shape[0] if self.means.ndim else -1
        k = self.sh.shape[1] if self.sh.ndim == 3 else 0
        expected = {
            "means": (n, 3),
            "log_scales": (n, 3),
            "rotations": (n, 4),
            "logit_opacities": (n,),
            "sh": (n, k, 3),
        }
        for name, shape in expected.items():
            tensor: Tensor = getattr(self, name)
            if tuple(tensor.shape) != shape:
                raise InputError(
                    f"{name} has the shape {tuple(tensor.shape)}, expected {shape} for {n} Gaussians",
                    hint="all five parameters must describe the same Gaussians",
                )
            if tensor.dtype != self.means.dtype or tensor.device != self.means.device:
                raise InputError(
                    f"{name} is {tensor.dtype} on {tensor.device}, "
                    f"means are {self.means.dtype} on {self.means.device}",
                    hint="keep all five parameters in one precision on one device",
                )
        if k not in SH_DEGREES:
            raise InputError(
                f"sh holds {k} coefficients a channel", hint="store 1, 4, 9 or 16 of them (degree 0 to 3)"
            )

    @property
    def num(self) -> int:
        """Number of Gaussians N."""
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Highest spherical-harmonics degree that the storage holds."""
        return SH_DEGREES[int(self.sh.shape[1])]

    @property
    def device(self) -> torch.device:
        """Where the tensors lie."""
        return self.means.device

    def tensors(self) -> dict[str, Tensor]:
        """The five parameter tensors by name, in the order of the fields."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def to(self, device: torch.device | str) -> Gaussians:
        """The same Gaussians on another device."""
        return Gaussians(**{name: tensor.to(device) for name, tensor in self.tensors().items()})

    def clone(self) -> Gaussians:
        """A copy that shares no memory."""
        return Gaussians(**{name: tensor.clone() for name, tensor in self.tensors().items()})

    def detach(self) -> Gaussians:
        """The same memory outside any autograd graph."""
        return Gaussians(**{name: tensor.detach() for name, tensor in self.tensors().items()})

    def select(self, index: Tensor) -> Gaussians:
        """The Gaussians that a bool mask or an index tensor names, as contiguous copies."""
        return Gaussians(**{name: tensor[index].contiguous() for name, tensor in self.tensors().items()})
