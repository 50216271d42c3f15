"""``scene.ply``, read by plyfile and by ClearGS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cleargs.errors import StoreError
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.ply import read_ply, write_ply
from cleargs.splat.scene import Scene

plyfile = pytest.importorskip("plyfile")


def scene(sh_degree: int, count: int = 5) -> Scene:
    rng = np.random.default_rng(sh_degree)
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, (sh_degree + 1) ** 2, 3)]
    tensors = [torch.from_numpy(rng.standard_normal(shape).astype(np.float32)) for shape in shapes]
    return Scene(Gaussians(*tensors), antialias=sh_degree == 1, background=(0.25, 0.5, 1.0))


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_plyfile_reads_the_inria_layout(sh_degree: int, tmp_path: Path) -> None:
    made = scene(sh_degree)
    write_ply(tmp_path / "scene.ply", made)
    ply = plyfile.PlyData.read(str(tmp_path / "scene.ply"))
    assert not ply.text
    assert ply.byte_order == "<"
    vertex = ply["vertex"]
    coefficients = (sh_degree + 1) ** 2
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    expected += [f"f_rest_{i}" for i in range(3 * (coefficients - 1))]
    expected += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert [p.name for p in vertex.properties] == expected
    gaussians = made.gaussians
    for axis, name in enumerate("xyz"):
        assert np.array_equal(vertex[name], gaussians.means[:, axis].numpy())
    assert np.array_equal(vertex["opacity"], gaussians.logit_opacities.numpy())
    assert np.array_equal(vertex["scale_2"], gaussians.log_scales[:, 2].numpy())
    assert np.array_equal(vertex["rot_0"], gaussians.rotations[:, 0].numpy())
    assert np.array_equal(vertex["f_dc_1"], gaussians.sh[:, 0, 1].numpy())
    for term in range(1, coefficients):  # all terms of red, then of green, then of blue
        for colour in range(3):
            column = vertex[f"f_rest_{colour * (coefficients - 1) + term - 1}"]
            assert np.array_equal(column, gaussians.sh[:, term, colour].numpy())
    assert f"SplatRenderMode: {'mip' if made.antialias else 'default'}" in ply.comments


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_read_back_exactly(sh_degree: int, tmp_path: Path) -> None:
    made = scene(sh_degree)
    write_ply(tmp_path / "a.ply", made)
    back = read_ply(tmp_path / "a.ply")
    assert (back.antialias, back.background) == (made.antialias, made.background)
    for name, tensor in made.gaussians.tensors().items():
        assert torch.equal(back.gaussians.tensors()[name], tensor), name
        assert back.gaussians.tensors()[name].is_contiguous()
    write_ply(tmp_path / "b.ply", back)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_no_gaussians(tmp_path: Path) -> None:
    write_ply(tmp_path / "empty.ply", scene(1, count=0))
    assert read_ply(tmp_path / "empty.ply").gaussians.num == 0


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:-4],
        lambda data: data[:40],
        lambda data: b"",
        lambda data: data.replace(b"opacity", b"opaciti"),
        lambda data: data.replace(b"binary_little_endian", b"ascii"),
        lambda data: data.replace(b"element vertex 5", b"element"),
        lambda data: data.replace(b"element vertex 5", b"element vertex"),
        lambda data: data.replace(b"element vertex 5", b"element vertex -1"),
        lambda data: data.replace(b"property float opacity", b"property"),
        lambda data: data[:-4] + np.float32(np.nan).tobytes(),
        lambda data: data[:-4] + np.float32(np.inf).tobytes(),
    ],
)
def test_a_damaged_file_is_refused(damage: object, tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    write_ply(path, scene(1))
    path.write_bytes(damage(path.read_bytes()))  # type: ignore[operator]
    with pytest.raises(StoreError, match=r"scene\.ply"):
        read_ply(path)
