"""A transformed scene has the same render from a transformed camera."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from benchmarks.speed import reference
from cleargs.errors import InputError
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.transforms import sh_basis, sh_rotation, transform_scene

SCALE = 3.7
ROTATION = Rotation.from_rotvec([0.9, -1.3, 0.4]).as_matrix()
TRANSLATION = np.array([5.0, -2.0, 11.0])


def make_scene(count: int, coefficients: int) -> Scene:
    chance = np.random.default_rng(3)

    def normal(*shape: int) -> torch.Tensor:
        return torch.from_numpy(chance.normal(size=shape)).float()

    means = normal(count, 3) * 0.4 + torch.tensor([0.0, 0.0, 3.0])
    sh = normal(count, coefficients, 3) * 0.25  # view-dependent in every degree
    gaussians = Gaussians(
        means=means,
        log_scales=normal(count, 3) * 0.4 - 1.8,
        rotations=normal(count, 4),
        logit_opacities=normal(count),
        sh=sh,
    )
    return Scene(gaussians)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_render_is_unchanged(coefficients: int) -> None:
    scene = make_scene(40, coefficients)
    view = np.eye(4)
    view[:3, :3] = Rotation.from_rotvec([0.05, 0.1, -0.2]).as_matrix()
    camera = Camera(48, 36, 40.0, 40.0, 24.0, 18.0, view)
    back = np.eye(4)  # new world to old world
    back[:3, :3] = ROTATION.T / SCALE
    back[:3, 3] = -ROTATION.T @ TRANSLATION / SCALE
    moved_view = view @ back
    moved_view[:3] *= SCALE  # the same camera in units of the new world
    moved_camera = Camera(48, 36, 40.0, 40.0, 24.0, 18.0, moved_view)

    moved = transform_scene(scene, scale=SCALE, rotation=ROTATION, translation=TRANSLATION)

    def double(gaussians: Gaussians) -> Gaussians:
        return Gaussians(**{name: tensor.double() for name, tensor in gaussians.tensors().items()})

    def render(gaussians: Gaussians, camera: Camera) -> torch.Tensor:
        return reference.render(gaussians, camera, sh_count=coefficients).image

    before = render(double(scene.gaussians), camera)
    after = render(double(moved.gaussians), moved_camera)
    unturned = Gaussians(**{**double(moved.gaussians).tensors(), "sh": double(scene.gaussians).sh})
    assert before.max() > 0.3 and before.std() > 0.05
    # The largest difference is about 2e-6, from the rounding of the parameters to float32.
    assert torch.allclose(before, after, atol=2e-5)
    if coefficients > 1:
        assert not torch.allclose(before, render(unturned, moved_camera), atol=1e-2), "SH must rotate, too"


def test_sh_rotation_is_orthogonal_and_composes() -> None:
    first = torch.from_numpy(ROTATION)
    second = torch.from_numpy(Rotation.from_rotvec([-0.2, 0.7, 2.0]).as_matrix())
    one, two, both = sh_rotation(first, 16), sh_rotation(second, 16), sh_rotation(second @ first, 16)
    assert torch.allclose(one @ one.T, torch.eye(16, dtype=torch.float64), atol=1e-12)
    assert torch.allclose(two @ one, both, atol=1e-12)
    degree_ends = (0, 1, 4, 9, 16)
    for begin, end in pairwise(degree_ends):
        outside = one[begin:end].clone()
        outside[:, begin:end] = 0
        assert outside.abs().max() < 1e-12, "degrees do not mix"


def test_sh_rotation_rotates_the_function() -> None:
    rotation = torch.from_numpy(ROTATION)
    coefficients = torch.from_numpy(np.random.default_rng(1).normal(size=16))
    directions = torch.nn.functional.normalize(
        torch.from_numpy(np.random.default_rng(2).normal(size=(20, 3))), dim=1
    )
    turned = sh_basis(directions, 16) @ (sh_rotation(rotation, 16) @ coefficients)
    assert torch.allclose(turned, sh_basis(directions @ rotation, 16) @ coefficients, atol=1e-12)


def test_reflections_are_refused() -> None:
    with pytest.raises(ValueError, match="not a similarity"):
        transform_scene(
            make_scene(2, 4), scale=1.0, rotation=np.diag([1.0, 1.0, -1.0]), translation=TRANSLATION
        )


def test_a_scene_beyond_float32_is_refused() -> None:
    scene = Scene(
        Gaussians(
            means=torch.ones(2, 3),
            log_scales=torch.zeros(2, 3),
            rotations=torch.ones(2, 4),
            logit_opacities=torch.zeros(2),
            sh=torch.zeros(2, 1, 3),
        )
    )
    # Squares and differences of 1e38 overflow in the writers of packed formats; 1e-150 is 0.
    for scale in (1e39, 1e38, 1e-150):
        with pytest.raises(InputError, match="range of float32"):
            transform_scene(scene, scale=scale, rotation=np.eye(3), translation=np.zeros(3))
