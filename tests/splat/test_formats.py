"""Scenes in other programs' formats, decoded by independent readers or as the specification says."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from test_compressed_ply import make

from cleargs.errors import InputError
from cleargs.splat.camera import Camera, cameras_json
from cleargs.splat.constants import SH_C0
from cleargs.splat.formats import FORMATS, format_of, padded, write_scene
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.spz import spz
from cleargs.splat.transforms import sh_basis

ABOUT_X, ABOUT_Z = np.array([1.0, -1.0, -1.0]), np.array([-1.0, -1.0, 1.0])


def covariances(log_scales: NDArray[np.float32], quaternions: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return covariances [N, 3, 3], which do not depend on the sign of a quaternion w x y z."""
    turn = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    return np.asarray(
        turn * np.exp(2.0 * log_scales.astype(np.float64))[:, None, :] @ turn.transpose(0, 2, 1)
    )


def colours(sh: NDArray[np.float32], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the colours of SH coefficients [N, K, 3] in the directions [M, 3]."""
    basis = sh_basis(torch.from_numpy(directions), sh.shape[1]).numpy()
    return np.asarray(np.einsum("mk,nkc->nmc", basis, sh))


def gaussians(back: Any) -> Gaussians:
    """Return the Gaussians that gsply read."""
    return Gaussians(
        means=torch.from_numpy(np.array(back.means)),
        log_scales=torch.from_numpy(np.array(back.scales)),
        rotations=torch.from_numpy(np.array(back.quats)),
        logit_opacities=torch.from_numpy(np.array(back.opacities)),
        sh=torch.from_numpy(np.concatenate([back.sh0[:, None], back.shN], axis=1)),
    )


def assert_turned(
    found: Gaussians,
    made: Gaussians,
    signs: NDArray[np.float64],
    sh_within: float,
    means_within: float = 2e-3,
) -> None:
    """Check that ``found`` is ``made`` after half a turn (or none), with its colours."""
    assert np.allclose(found.means.numpy(), made.means.numpy() * signs, atol=means_within)
    expected = covariances(made.log_scales.numpy(), made.rotations.numpy()) * np.outer(signs, signs)
    got = covariances(found.log_scales.numpy(), found.rotations.numpy())
    assert np.abs(got - expected).max() < 0.08 * np.abs(expected).max()  # log scales in steps of 1/16 (SPZ)
    assert torch.allclose(
        found.logit_opacities.sigmoid(), made.logit_opacities.sigmoid(), atol=0.5 / 255 + 1e-3
    )
    seen = np.random.default_rng(0).normal(size=(20, 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    difference = colours(found.sh.numpy(), seen * signs) - colours(made.sh.numpy(), seen)
    assert np.abs(difference).mean() < sh_within
    if (signs == 1.0).all():
        return
    untouched = colours(made.sh.numpy(), seen * signs) - colours(made.sh.numpy(), seen)
    assert np.abs(untouched).mean() > 4 * sh_within, "the test must detect colours that did not rotate"


def read_spz(path: Path) -> Any:
    """Read a file with gsply: means, log scales, quaternions w x y z, opacity logits, sh0, shN."""
    return pytest.importorskip("gsply.spz").read_spz(str(path))


def scene(sh_degree: int = 3, count: int = 300) -> Scene:
    made = make(count, sh_degree)
    made.sh.clamp_(-0.9, 0.9)  # the range of SPZ
    made.rotations.div_(made.rotations.norm(dim=1, keepdim=True))
    return Scene(made, antialias=True)


@pytest.mark.parametrize("sh_degree", [1, 3])
def test_spz_read_by_gsply(sh_degree: int, tmp_path: Path) -> None:
    made = scene(sh_degree)
    write_scene(tmp_path / "a.spz", made, "spz")
    found = gaussians(read_spz(tmp_path / "a.spz"))
    assert_turned(found, made.gaussians, ABOUT_X, sh_within=0.06)  # 4 bits for the higher degrees


@pytest.mark.parametrize("sh_degree", [0, 2])
def test_glb_follows_the_specification(sh_degree: int, tmp_path: Path) -> None:
    made = scene(sh_degree)
    write_scene(tmp_path / "a.glb", made, "glb")
    content = (tmp_path / "a.glb").read_bytes()
    assert struct.unpack("<4sII", content[:12]) == (b"glTF", 2, len(content))
    length, kind = struct.unpack("<I4s", content[12:20])
    document = json.loads(content[20 : 20 + length])
    binary, tag = struct.unpack("<I4s", content[20 + length : 28 + length])
    assert (kind, tag, length % 4, binary % 4) == (b"JSON", b"BIN\0", 0, 0)
    assert 28 + length + binary == len(content) and document["buffers"] == [{"byteLength": binary}]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"

    def attribute(name: str) -> NDArray[np.float32]:
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        start = 28 + length + view["byteOffset"]
        assert view["byteOffset"] % 4 == 0 and accessor["count"] == made.gaussians.num
        kind = np.uint8 if accessor["componentType"] == 5121 else "<f4"
        values = np.frombuffer(content[start : start + view["byteLength"]], kind).reshape(-1, width)
        if "min" in accessor:
            assert (
                accessor["min"] == values.min(axis=0).tolist()
                and accessor["max"] == values.max(axis=0).tolist()
            )
        return np.array(values)

    prefix = "KHR_gaussian_splatting:"
    terms = [(degree, term) for degree in range(sh_degree + 1) for term in range(2 * degree + 1)]
    found = Gaussians(
        means=torch.from_numpy(attribute("POSITION")),
        log_scales=torch.from_numpy(attribute(f"{prefix}SCALE")).log(),
        rotations=torch.from_numpy(attribute(f"{prefix}ROTATION")[:, [3, 0, 1, 2]]),
        logit_opacities=torch.from_numpy(attribute(f"{prefix}OPACITY")[:, 0]).logit(),
        sh=torch.from_numpy(
            np.stack([attribute(f"{prefix}SH_DEGREE_{d}_COEF_{t}") for d, t in terms], axis=1)
        ),
    )
    if sh_degree:
        assert_turned(found, made.gaussians, ABOUT_Z, sh_within=1e-5)
    assert attribute("COLOR_0").shape == (made.gaussians.num, 4)


def test_glb_colours_are_linear(tmp_path: Path) -> None:
    """The specification decodes sRGB for COLOR_0; viewers without the extension showed it too bright."""
    made = scene(0, count=3)
    made.gaussians.sh[:, 0] = (torch.tensor([[0.0], [0.5], [1.5]]) - 0.5) / SH_C0
    made.gaussians.logit_opacities[:] = 0.0
    write_scene(tmp_path / "a.glb", made, "glb")
    content = (tmp_path / "a.glb").read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    document = json.loads(content[20 : 20 + length])
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    start = 28 + length + document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    colours = np.frombuffer(content[start : start + 12], np.uint8).reshape(3, 4)
    assert colours.tolist() == [[0, 0, 0, 128], [55, 55, 55, 128], [255, 255, 255, 128]]


def test_usd_read_by_openusd(tmp_path: Path) -> None:
    pxr = pytest.importorskip("pxr", reason="the extra `usd` is not installed")
    del pxr
    from pxr import Usd, UsdGeom, UsdVol

    made = scene(2)
    write_scene(tmp_path / "a.usdc", made, "usdc")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    degree = splats.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    sh = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(), np.float32)
    quaternions = [[q.GetReal(), *q.GetImaginary()] for q in splats.GetOrientationsAttr().Get()]
    found = Gaussians(
        means=torch.from_numpy(np.array(splats.GetPositionsAttr().Get(), np.float32)),
        log_scales=torch.from_numpy(np.array(splats.GetScalesAttr().Get(), np.float32)).log(),
        rotations=torch.tensor(quaternions),
        logit_opacities=torch.from_numpy(np.array(splats.GetOpacitiesAttr().Get(), np.float32)).logit(),
        sh=torch.from_numpy(sh.reshape(made.gaussians.num, (degree + 1) ** 2, 3)),
    )
    assert_turned(found, made.gaussians, ABOUT_Z, sh_within=1e-5)


def test_a_scene_too_large_for_spz_is_refused() -> None:
    """Such positions were once clipped without a warning."""
    made = scene(0)
    made.gaussians.means[3, 1] = 9e6
    with pytest.raises(InputError, match=r"\.spz stores at most"):
        spz(made)


def test_spz_keeps_positions_far_away(tmp_path: Path) -> None:
    """The 24 bits are divided between integer and fraction by the largest coordinate."""
    made = scene(0)
    made.gaussians.means.mul_(300.0)
    made.gaussians.log_scales.add_(np.log(300.0))
    write_scene(tmp_path / "a.spz", made, "spz")
    back = read_spz(tmp_path / "a.spz")
    reach = float(made.gaussians.means.abs().max())
    assert reach > 2048  # the limit with 12 fraction bits
    assert np.abs(back.means * ABOUT_X - made.gaussians.means.numpy()).max() < 1 / 32 * float(
        made.gaussians.log_scales.exp().median()
    )


def test_the_file_extension_selects_the_format() -> None:
    assert [format_of(Path(f"A.b.{ending.upper()}")) for ending in FORMATS] == list(FORMATS)
    for name in ("room.splat", "room", "ply", "room.compressed"):
        with pytest.raises(InputError, match="not a known scene format"):
            format_of(Path(name))


def test_padding_changes_no_colour() -> None:
    made = scene(1)
    full = padded(made, 3)
    directions = np.eye(3)
    assert full.gaussians.sh_degree == 3 and full.antialias
    assert np.allclose(
        colours(full.gaussians.sh.numpy(), directions), colours(made.gaussians.sh.numpy(), directions)
    )
    with pytest.raises(InputError, match="degree 3"):
        padded(full, 1)


def test_cameras_follow_the_scene() -> None:
    turn = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.1, 0.5, 0.0]).as_matrix()
    pose[:3, 3] = [1.0, 2.0, 3.0]
    camera = Camera(640, 480, 500.0, 510.0, 320.0, 240.0, pose)
    shift = np.array([4.0, 5.0, 6.0])
    (entry,) = cameras_json([("a.jpg", camera)], scale=2.0, rotation=turn, translation=shift)
    point = np.array([0.3, -0.4, 2.0])  # at the same pixel, twice as far away
    before = pose[:3, :3] @ point + pose[:3, 3]
    after = np.array(entry["rotation"]).T @ (2.0 * turn @ point + shift - entry["position"])
    assert np.allclose(after, 2.0 * before) and (entry["fx"], entry["img_name"]) == (500.0, "a.jpg")
