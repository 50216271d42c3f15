"""Adam over the five parameter groups of a scene, and over the exposure affines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.splat.adam import adam_step
from cleargs.splat.compensation import Exposure, centred
from cleargs.splat.config import TrainConfig
from cleargs.splat.gaussians import Gaussians

SH_REST_DIVISOR = 20.0
"""The SH terms above the constant learn this much slower (Inria)."""


@dataclass
class Moments:
    """Adam's running means of the gradients and of their squares, by parameter name."""

    first: dict[str, Tensor]
    second: dict[str, Tensor]

    @classmethod
    def zeros(cls, gaussians: Gaussians) -> Moments:
        """Fresh moments for these parameters."""
        tensors = gaussians.tensors()
        return cls(
            {name: torch.zeros_like(tensor) for name, tensor in tensors.items()},
            {name: torch.zeros_like(tensor) for name, tensor in tensors.items()},
        )


class Rates:
    """Learning rates by parameter name. The world is normalised, so the scene's extent is 1."""

    def __init__(self, config: TrainConfig, coefficients: int, device: torch.device | str = "cpu") -> None:
        self._config = config
        sh = torch.full((coefficients * 3,), config.lr_sh / SH_REST_DIVISOR, device=device)
        sh[:3] = config.lr_sh
        self._fixed: dict[str, float | Tensor] = {
            "log_scales": config.lr_scales,
            "rotations": config.lr_rotations,
            "logit_opacities": config.lr_opacities,
            "sh": sh,
        }

    def means(self, step: int) -> float:
        """Rate of the means before step ``step``, counted from 0."""
        return self._config.lr_means * float(self._config.lr_means_final ** (step / self._config.steps))

    def at(self, step: int) -> dict[str, float | Tensor]:
        """Every rate before step ``step``, counted from 0."""
        return {"means": self.means(step), **self._fixed}


def step_gaussians(
    gaussians: Gaussians,
    gradients: Gaussians,
    moments: Moments,
    rates: dict[str, float | Tensor],
    *,
    step: int,
) -> None:
    """One Adam step of every group in place; ``step`` counts from 1 (bias correction)."""
    slopes = gradients.tensors()
    for name, parameter in gaussians.tensors().items():
        adam_step(
            parameter, slopes[name], moments.first[name], moments.second[name], step=step, lr=rates[name]
        )


class ExposureOptimiser:
    """Learns the affines; only the frame just seen moves, and the weighted median stays the identity."""

    def __init__(self, exposure: Exposure, weights: NDArray[np.float64], rate: float) -> None:
        self.frame_ids = exposure.frame_ids
        self.affines = centred(exposure.affines, weights)
        self.first = np.zeros_like(self.affines)
        self.second = np.zeros_like(self.affines)
        self.steps = np.zeros(len(self.frame_ids), np.int64)
        self._weights = weights
        self._rate = rate
        self._index = {int(frame_id): index for index, frame_id in enumerate(self.frame_ids)}

    @property
    def exposure(self) -> Exposure:
        """A snapshot of what is learned."""
        return Exposure(self.frame_ids.copy(), self.affines.copy())

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that changes, by name, for a checkpoint."""
        return {"affines": self.affines, "first": self.first, "second": self.second, "steps": self.steps}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Go on from what `arrays` gave."""
        self.affines, self.first = arrays["affines"], arrays["first"]
        self.second, self.steps = arrays["second"], arrays["steps"]

    def affine(self, frame_id: int) -> Tensor:
        """The affine of a frame [3, 4] float32."""
        return torch.from_numpy(self.affines[self._index[frame_id]].astype(np.float32))

    def step(self, frame_id: int, gradient: NDArray[np.float64]) -> None:
        """One Adam step of a frame's affine along ``gradient`` [3, 4]."""
        i = self._index[frame_id]
        self.steps[i] += 1
        self.first[i] += 0.1 * (gradient - self.first[i])
        self.second[i] += 0.001 * (gradient * gradient - self.second[i])
        first = self.first[i] / (1.0 - 0.9 ** int(self.steps[i]))
        second = self.second[i] / (1.0 - 0.999 ** int(self.steps[i]))
        self.affines[i] -= self._rate * first / (np.sqrt(second) + 1e-15)
        self.affines = centred(self.affines, self._weights)
