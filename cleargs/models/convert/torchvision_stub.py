"""torchvision beside a torch without its compiled operators."""

from __future__ import annotations

import torch


def mend_torchvision() -> None:
    """Let torchvision be imported beside a CPU build of torch.

    Its released build registers shapes for two detection operators that its library, which does not load
    there, would define. Declared here, they can be imported; nothing converted calls them.
    """
    for name in ("nms", "qnms"):
        if not hasattr(torch.ops.torchvision, name):
            torch.library.define(
                f"torchvision::{name}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"
            )
