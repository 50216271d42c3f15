"""The parameters of N anisotropic Gaussians, before activation."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from cleargs.errors import InputError
from cleargs.splat.constants import SH_DEGREES

OPAQUE = 16.0
"""Logit that replaces an infinite one; its opacity is 1 - 1e-7."""

FLAT = -40.0
"""Log scale that replaces minus infinity."""


@dataclass
class Gaussians:
    """Parameters of N Gaussians as the optimiser changes them (as in the Inria PLY), or their gradients.

    The covariance is R diag(exp(2 log_scales)) Rᵀ with R from the normalised quaternion. The opacity is
    sigmoid(logit_opacities). The colour is max(SH(direction) + 0.5, 0) in sRGB. K, the number of SH
    coefficients per channel, is 1, 4, 9 or 16 (degree 0 to 3).

    Raises:
        InputError: The tensors differ in N, precision or device, or have an unexpected shape.
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
                    hint="give all five parameters of the same Gaussians",
                )
            if tensor.dtype != self.means.dtype or tensor.device != self.means.device:
                raise InputError(
                    f"{name} is {tensor.dtype} on {tensor.device}, "
                    f"means are {self.means.dtype} on {self.means.device}",
                    hint="use the same precision and device for all five parameters",
                )
        if k not in SH_DEGREES:
            raise InputError(
                f"sh has {k} coefficients per channel", hint="give 1, 4, 9 or 16 of them (degree 0 to 3)"
            )

    def __repr__(self) -> str:
        return f"<{self.num} Gaussians, SH degree {self.sh_degree}, on {self.device}>"

    @property
    def num(self) -> int:
        """Number of Gaussians N."""
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the stored spherical harmonics, 0 to 3."""
        return SH_DEGREES[int(self.sh.shape[1])]

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.means.device

    def tensors(self) -> dict[str, Tensor]:
        """Return the five parameter tensors by name, in the order of the fields."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def to(self, device: torch.device | str) -> Gaussians:
        """Return the Gaussians on a device."""
        return Gaussians(**{name: tensor.to(device) for name, tensor in self.tensors().items()})

    def clone(self) -> Gaussians:
        """Return a copy that shares no memory."""
        return Gaussians(**{name: tensor.clone() for name, tensor in self.tensors().items()})

    def detach(self) -> Gaussians:
        """Return the Gaussians detached from the autograd graph; they share memory."""
        return Gaussians(**{name: tensor.detach() for name, tensor in self.tensors().items()})

    def select(self, index: Tensor) -> Gaussians:
        """Return contiguous copies of the Gaussians at ``index``, a bool mask [N] or indices."""
        return Gaussians(**{name: tensor[index].contiguous() for name, tensor in self.tensors().items()})

    def bounded(self) -> Gaussians:
        """Return the Gaussians without infinite opacities (`OPAQUE`), zero sizes (`FLAT`) and zero rotations.

        Files of other programs have all three. Raises ValueError if another value is not finite.
        """
        nan, identity = float("nan"), self.rotations.new_tensor([1.0, 0.0, 0.0, 0.0])
        unset = (self.rotations == 0.0).all(dim=1, keepdim=True)
        tensors = self.tensors() | {
            "logit_opacities": torch.nan_to_num(self.logit_opacities, nan, OPAQUE, -OPAQUE),
            "log_scales": torch.nan_to_num(self.log_scales, nan, math.inf, FLAT),
            "rotations": torch.where(unset, identity, self.rotations),
        }
        found = Gaussians(**tensors)
        if fault := found.fault():
            raise ValueError(fault)
        return found

    def fault(self) -> str | None:
        """Name the first parameter with NaN or infinity, and its number of such Gaussians; None if finite."""
        tensors = self.tensors()
        if self.device.type == "cpu":  # NumPy is much faster than torch here
            finite = all(bool(np.isfinite(tensor.numpy()).all()) for tensor in tensors.values())
        else:  # waits for the GPU only once
            finite = bool(torch.stack([torch.isfinite(tensor).all() for tensor in tensors.values()]).all())
        if finite:
            return None
        for name, tensor in tensors.items():
            sound = int(torch.isfinite(tensor).reshape(self.num, -1).all(1).sum())
            if sound < self.num:
                return f"{name} is not finite in {self.num - sound} of {self.num} Gaussians"
        return None
