"""A fit of a frame's motion runs on the back end of the render's device."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from cleargs.formation.frame import FrameFormation, fit_motion
from cleargs.splat.camera import Camera, look_at
from cleargs.splat.config import FormationConfig
from cleargs.splat.kernels.cpu import backend as cpu
from cleargs.splat.types import Render


def test_a_fit_uses_the_back_end_of_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    devices, called = [], set()

    class Counting:
        def __getattr__(self, name: str) -> Any:
            called.add(name)
            return getattr(cpu, name)

    def backend_for(device: torch.device) -> Counting:
        devices.append(device)
        return Counting()

    def render(camera: Camera) -> Render:
        shown = torch.rand(camera.height, camera.width, 5, generator=torch.Generator().manual_seed(1))
        return Render(shown[..., :3], 0.9 + 0.1 * shown[..., 3], 2.0 + shown[..., 4])

    monkeypatch.setattr("cleargs.formation.frame.backend_for", backend_for)
    pose = look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]))
    camera = Camera(48, 40, 50.0, 50.0, 24.0, 20.0, pose)
    target = torch.rand(40, 48, 3, generator=torch.Generator().manual_seed(2))
    fit_motion(FrameFormation(0), FormationConfig(), camera, None, target, None, render)
    assert devices == [torch.device("cpu")]
    assert called <= {"misfit", "normal_equations"}
    assert "misfit" in called
