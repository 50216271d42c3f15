"""Muon: gradient descent with momentum and orthogonalised matrix updates.

Source: Jordan et al., "Muon: An optimizer for hidden layers in neural networks" (2024). Updates are scaled to
the size of Adam updates as in Liu et al., "Muon is scalable for LLM training" (2025). The weight of a
convolution [out, in, h, w] is treated as a matrix [out, in h w].
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)
"""Coefficients of the quintic iteration that moves all singular values towards one (Jordan et al.)."""


def orthogonalise(matrix: Tensor, iterations: int = 5) -> Tensor:
    """Return the nearest matrix with singular values of about one, by Newton-Schulz iterations."""
    a, b, c = NEWTON_SCHULZ
    tall = matrix.shape[0] > matrix.shape[1]
    x: Tensor = matrix.T if tall else matrix
    x = x / (x.norm() + 1e-7)
    for _ in range(iterations):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.T if tall else x


class Muon(torch.optim.Optimizer):
    """Muon for weights of two or more dimensions.

    Args:
        parameters: The weights.
        lr: Learning rate, comparable to one of Adam.
        momentum: Decay of the running mean of gradients.
    """

    def __init__(self, parameters: Iterable[Tensor], lr: float, momentum: float = 0.95) -> None:
        super().__init__(parameters, {"lr": lr, "momentum": momentum})

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]  # no closure: the training loop computes the gradient
        """Update every parameter that has a gradient."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                state = self.state[weight]
                if "mean" not in state:
                    state["mean"] = torch.zeros_like(weight)
                state["mean"].lerp_(weight.grad, 1.0 - group["momentum"])
                ahead = weight.grad.lerp(state["mean"], group["momentum"])
                update = orthogonalise(ahead.flatten(1))
                size = 0.2 * max(update.shape) ** 0.5
                weight.add_(update.view_as(weight), alpha=-group["lr"] * size)
