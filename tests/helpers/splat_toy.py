"""A tiny scene with known Gaussians and a ring of cameras, for the tests of trainings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.views import TrainingView

WIDTH, HEIGHT = 40, 30
Image = NDArray[np.uint8]


def gaussians(count: int = 60, *, seed: int = 0, sh_degree: int = 0) -> Gaussians:
    """Opaque coloured blobs within 0.4 of the origin."""
    rng = np.random.default_rng(seed)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = rng.uniform(-1.2, 1.2, (count, 3))
    return Gaussians(
        means=torch.from_numpy(rng.uniform(-0.4, 0.4, (count, 3)).astype(np.float32)),
        log_scales=torch.from_numpy(np.log(rng.uniform(0.04, 0.1, (count, 3))).astype(np.float32)),
        rotations=torch.from_numpy(rng.standard_normal((count, 4)).astype(np.float32)),
        logit_opacities=torch.full((count,), 2.0),
        sh=torch.from_numpy(sh),
    )


def camera(angle: float) -> Camera:
    """A camera on a circle of radius 1 around the origin, looking at it."""
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = (0.0, 0.0, 1.0)
    return Camera(WIDTH, HEIGHT, 40.0, 40.0, WIDTH / 2, HEIGHT / 2, pose)


def images(truth: Gaussians, count: int) -> list[Image]:
    """Renders of ``truth``, as uint8, by cameras at ``count`` angles over half a circle."""
    engine = rasteriser_for("cpu")
    shown = [engine.forward(truth, camera(angle)).image.numpy().copy() for angle in angles(count)]
    return [np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8) for image in shown]


def angles(count: int) -> list[float]:
    return [np.pi * index / count for index in range(count)]


def views(pictures: list[Image], *, weights: list[float] | None = None) -> list[TrainingView]:
    """Real views of the images, in the order of `images`."""
    weights = weights or [1.0] * len(pictures)
    return [
        TrainingView(index, camera(angle), weight, "real", keep(picture))
        for index, (angle, weight, picture) in enumerate(
            zip(angles(len(pictures)), weights, pictures, strict=True)
        )
    ]


def keep(
    picture: Image, mask: NDArray[np.bool_] | None = None
) -> Callable[[], tuple[Image, NDArray[np.bool_] | None]]:
    """A loader that returns an image from memory."""
    return lambda: (picture, mask)


def refuse() -> tuple[Image, None]:
    """A loader that must not be called."""
    raise AssertionError("a view was decoded that no training may look at")


def start(count: int = 60, *, sh_degree: int = 0) -> Scene:
    """The start of a toy training: other Gaussians than the truth, half transparent."""
    begin = gaussians(count, seed=99, sh_degree=sh_degree)
    begin.logit_opacities.zero_()
    return Scene(begin)
