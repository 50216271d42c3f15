"""Limits of the launches, copies and waits of a training step."""

from __future__ import annotations

import numpy as np
import torch
from device_calls import DeviceCalls
from helpers import splat_toy

from cleargs.splat.config import TrainConfig
from cleargs.splat.trainer import Trainer


def test_the_counter_sees_kernels_operations_copies_and_waits(device):
    from cleargs.splat.kernels.cuda import elementwise

    calls = DeviceCalls()
    with calls.counting(elementwise.adam):
        numbers = torch.tensor([3.0, 4.0]) + 1.0  # on the host
        moved = numbers.to(device)
        doubled = 2.0 * moved
        view = doubled[1:].reshape(1, 1)
        assert view.item() == 10.0
        torch.tensor(5.0, device=device)
    assert calls.counts == {("copy", "test"): 2, ("operation", "test: mul"): 1, ("wait", "test"): 1}


def test_a_step_launches_few_kernels(device, monkeypatch):
    """Without image formation, texture and refinement, and if no losses are read (every tenth step)."""
    from cleargs.splat.kernels.cuda import elementwise

    monkeypatch.setattr(splat_toy, "WIDTH", 20)
    monkeypatch.setattr(splat_toy, "HEIGHT", 15)
    rng = np.random.default_rng(0)
    views = splat_toy.views([rng.integers(0, 256, (15, 20, 3), dtype=np.uint8) for _ in range(2)])
    config = TrainConfig(steps=200, budget=12, coarse_share=0.0, texture=0.0)
    scene = splat_toy.start(12, sh_degree=1)
    trainer = Trainer(scene, views, config, seed=(7,), device=str(device))
    for _ in range(2):  # each view is read once
        trainer.step()
    calls = DeviceCalls()
    with calls.counting(elementwise.adam):
        trainer.step()
    print(calls.table())
    assert calls.total("kernel") <= 14
    assert calls.total("operation") <= 5
    assert calls.total("copy") == 0
    assert calls.total("wait") <= 1  # for the number of pairs
