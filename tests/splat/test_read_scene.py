"""Scene files of ClearGS and of other programs are read as their formats define them, or refused."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_compressed_ply import make

from cleargs.errors import CleargsError, InputError, StoreError
from cleargs.splat.compressed_ply import morton_order
from cleargs.splat.constants import SH_C0
from cleargs.splat.formats import FORMATS, padded, read_scene, write_scene
from cleargs.splat.gaussians import OPAQUE, Gaussians
from cleargs.splat.ply import read_ply, write_ply
from cleargs.splat.scene import Scene
from cleargs.splat.spz import from_spz, spz
from cleargs.splat.transforms import transform_scene

needs_usd = pytest.mark.skipif(find_spec("pxr") is None, reason="the extra `usd` is not installed")
KINDS = [pytest.param(kind, marks=needs_usd if kind == "usdc" else ()) for kind in sorted(FORMATS)]
SORTED = ("sog", "compressed.ply")  # in Morton order


def scene(sh_degree: int = 3, count: int = 300) -> Scene:
    made = make(count, sh_degree)
    made.sh.clamp_(-0.9, 0.9)  # the range of SPZ
    made.rotations.div_(made.rotations.norm(dim=1, keepdim=True))
    return Scene(made)


def trip(made: Scene, kind: str, folder: Path) -> tuple[Gaussians, Gaussians]:
    """Return what was written, and what was read, in one order."""
    write_scene(folder / f"a.{kind}", made, kind)
    order = np.arange(made.gaussians.num)
    if kind in SORTED:
        order = morton_order(made.gaussians.means.numpy())
    return made.gaussians.select(torch.from_numpy(order)), read_scene(folder / f"a.{kind}").gaussians


def assert_near(made: Gaussians, found: Gaussians) -> None:
    size = float(made.log_scales.exp().median())
    spread = float(made.means.abs().max())
    assert (found.means - made.means).abs().max() < max(size / 4, spread / 2**11)  # 10 bits, compressed PLY
    assert (found.log_scales - made.log_scales).abs().mean() < 1 / 60  # half a step of SPZ is 1/32
    aligned = (found.rotations * torch.nn.functional.normalize(made.rotations)).sum(dim=1).abs()
    assert aligned.min() > 1 - 1e-4
    assert (found.logit_opacities.sigmoid() - made.logit_opacities.sigmoid()).abs().max() < 0.5 / 255 + 1e-3
    seen = made.logit_opacities > -5.0  # .sog has no colours for alpha 0
    assert (found.sh - made.sh)[seen].abs().mean() < 0.02  # a step of .compressed.ply is 1/32


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_every_format_is_read_back(kind: str, sh_degree: int, tmp_path: Path) -> None:
    assert_near(*trip(scene(sh_degree), kind, tmp_path))


@pytest.mark.parametrize("sh_degree", [0, 2])
def test_spz_4_holds_the_same_as_3(sh_degree: int) -> None:
    three, four = spz(scene(sh_degree), 3), spz(scene(sh_degree), 4)
    assert gzip.decompress(three)[:8] == struct.pack("<II", 0x5053474E, 3)
    assert four[:8] == struct.pack("<II", 0x5053474E, 4)
    for name, tensor in from_spz(three).gaussians.tensors().items():
        assert torch.equal(tensor, from_spz(four).gaussians.tensors()[name])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("world", [1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3, 1e4])
def test_a_world_of_any_size_is_kept_or_refused(kind: str, world: float, tmp_path: Path) -> None:
    """.spz destroyed worlds of .01 without a word: 39.0 -> 34.4 dB."""
    big = transform_scene(scene(1), scale=world, rotation=np.eye(3), translation=np.zeros(3))
    try:
        made, found = trip(big, kind, tmp_path)
    except InputError as error:
        assert kind == "spz" and ".sog" in error.hint and not 0.1 <= world <= 100.0
        return
    back = {
        name: replace(values, means=values.means / world, log_scales=values.log_scales - np.log(world))
        for name, values in (("made", made), ("found", found))
    }
    assert_near(back["made"], back["found"])


def test_specks_do_not_keep_a_scene_out_of_spz(tmp_path: Path) -> None:
    """A draft of a small video had 0.7 % of them, and `export --for web` failed."""
    made = scene(0)
    sizes = torch.full_like(made.gaussians.log_scales, -5.0)
    sizes[: len(sizes) // 50, :2] = -15.0  # needles
    specks = replace(made, gaussians=replace(made.gaussians, log_scales=sizes))
    write_scene(tmp_path / "a.spz", specks, "spz")
    small = transform_scene(specks, scale=0.01, rotation=np.eye(3), translation=np.zeros(3))
    with pytest.raises(InputError, match="cannot hold the scene"):
        write_scene(tmp_path / "b.spz", small, "spz")


def test_spz_refuses_steps_that_the_gaussians_show(tmp_path: Path) -> None:
    """A small scene far from the origin has no bits left for its details."""
    far = transform_scene(scene(0), scale=0.1, rotation=np.eye(3), translation=np.array([3e4, 0.0, 0.0]))
    with pytest.raises(InputError, match="cannot hold the scene"):
        write_scene(tmp_path / "a.spz", far, "spz")
    near = trip(
        transform_scene(scene(0), scale=0.1, rotation=np.eye(3), translation=np.zeros(3)), "spz", tmp_path
    )
    assert (near[0].means - near[1].means).abs().max() < 2e-4  # it was 1/4096 in a world of any size


@pytest.mark.parametrize("kind", KINDS)
def test_zero_harmonics_stay_zero(kind: str, tmp_path: Path) -> None:
    """.compressed.ply has no level for 0: padding to degree 3 cost 39.3 -> 33.0 dB."""
    made, found = trip(padded(scene(1), 3), kind, tmp_path)
    degree = 1 if kind == "compressed.ply" else 3
    assert found.sh_degree == degree
    assert not found.sh[:, 4:].abs().gt(1e-6).any()
    assert (found.sh[:, 1:4] - made.sh[:, 1:4]).abs().mean() < 0.02


def test_zeros_that_were_rotated_are_zeros(tmp_path: Path) -> None:
    """``--sh-degree 3 --up y`` pads before it turns, and the rounding of the turn is not 0."""
    turn = Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix()
    turned = transform_scene(padded(scene(1), 3), scale=1.0, rotation=turn, translation=np.zeros(3))
    assert turned.gaussians.sh[:, 4:].any()
    _, found = trip(turned, "compressed.ply", tmp_path)
    assert found.sh_degree == 1


def test_zeros_between_other_harmonics_do_not_add_up(tmp_path: Path) -> None:
    made = scene(3)
    made.gaussians.sh[:, 4:] = 0.0
    made.gaussians.sh[0, 15] = 0.5
    _, found = trip(made, "compressed.ply", tmp_path)
    assert found.sh_degree == 3
    assert found.sh[:, 4:9].mean().abs() < 1e-3  # all of them were 1/64


def test_a_degree_0_padded_scene_needs_no_harmonics(tmp_path: Path) -> None:
    remarks = write_scene(tmp_path / "a.compressed.ply", padded(scene(0), 3), "compressed.ply")
    assert "degree 0" in remarks[0]
    assert b"f_rest" not in (tmp_path / "a.compressed.ply").read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_extreme_opacities_and_needles(kind: str, tmp_path: Path) -> None:
    made = scene(1)
    made.gaussians.sh[:, 0].clamp_(-0.5, 0.5)
    made.gaussians.logit_opacities[:4] = torch.tensor([np.inf, -np.inf, 60.0, -60.0])
    made.gaussians.rotations[8] = 0.0
    made.gaussians.log_scales[4:8] = torch.tensor([-1.0, -9.5, -9.5])
    if kind == "compressed.ply":  # its steps follow the range of 256 Gaussians
        made.gaussians.log_scales.clamp_(-9.5, 0.0)
    written, found = trip(made, kind, tmp_path)
    assert found.fault() is None
    assert (found.rotations.norm(dim=1) - 1.0).abs().max() < 1e-3
    assert (found.logit_opacities.sigmoid() - written.logit_opacities.sigmoid()).abs().max() < 1.5 / 255
    needles = written.log_scales[:, 1] == -9.5
    assert int(needles.sum()) >= 4
    assert (found.log_scales[needles] - written.log_scales[needles]).abs().max() < 0.05


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("antialias", [False, True])
def test_the_anti_aliasing_is_kept_or_said(antialias: bool, kind: str, tmp_path: Path) -> None:
    remarks = write_scene(tmp_path / f"a.{kind}", replace(scene(1), antialias=antialias), kind)
    if kind in ("glb", "usdc"):
        assert bool(remarks) == antialias
    else:
        assert read_scene(tmp_path / f"a.{kind}").antialias == antialias


@pytest.mark.parametrize(
    ("comments", "antialias"),
    [
        ([], False),
        (["SplatRenderMode: mip"], True),  # Brush, splat-transform
        (["splatrendermode: MIP"], True),
        (["SplatRenderMode: default"], False),
        (["antialiased 1"], True),  # Postshot
        (["antialiased 0"], False),
        (["cleargs antialias mip"], True),  # ClearGS 0.2
        (["cleargs antialias none"], False),
        (["SplatRenderMode: mip", "antialiased 0"], False),  # the last one
        (["cleargs antialias none", "SplatRenderMode: mip"], True),
        (["made by antialiased 1"], False),
    ],
)
@pytest.mark.parametrize("kind", ["ply", "compressed.ply"])
def test_the_comments_of_other_programs(
    comments: list[str], antialias: bool, kind: str, tmp_path: Path
) -> None:
    """A scene of Brush or Postshot was scored 1.4 dB too low without its compensation."""
    path = tmp_path / f"a.{kind}"
    write_scene(path, scene(1, count=5), kind)
    lines = "".join(f"comment {line}\n" for line in comments).encode()
    data = path.read_bytes().replace(b"comment SplatRenderMode: default\n", lines)
    path.write_bytes(data)
    assert read_scene(path).antialias == antialias


def _vertices(folder: Path) -> plyfile.PlyElement:
    write_ply(folder / "own.ply", scene(1))
    return plyfile.PlyData.read(str(folder / "own.ply"))["vertex"]


@pytest.mark.parametrize("form", ["text", "big endian", "double", "faces", "extra", "crlf"])
def test_plys_of_any_form(form: str, tmp_path: Path) -> None:
    vertex = _vertices(tmp_path)
    rows = np.array(vertex.data)
    if form == "double":
        rows = rows.astype([(name, "f8") for name in rows.dtype.names or ()])
    if form == "extra":
        wider = np.zeros(len(rows), [("segment", "u1"), *rows.dtype.descr, ("label", "i4")])
        for name in rows.dtype.names or ():
            wider[name] = rows[name]
        rows = wider
    elements = [plyfile.PlyElement.describe(rows, "vertex")]
    if form == "faces":
        faces = np.array([([0, 1, 2],)], [("vertex_indices", "O")])
        elements.append(plyfile.PlyElement.describe(faces, "face", val_types={"vertex_indices": "i4"}))
    written = plyfile.PlyData(
        elements,
        text=form == "text",
        byte_order=">" if form == "big endian" else "<",
        comments=["by another"],
    )
    with (tmp_path / "a.ply").open("wb") as file:
        written.write(file)
    if form == "crlf":
        head, end, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
        (tmp_path / "a.ply").write_bytes((head + end).replace(b"\n", b"\r\n") + body)
    own, found = read_ply(tmp_path / "own.ply").gaussians, read_scene(tmp_path / "a.ply").gaussians
    for name, tensor in own.tensors().items():
        assert torch.allclose(found.tensors()[name], tensor, atol=1e-6), name


@pytest.mark.parametrize("kind", ["u1", "f4"])
def test_plys_with_colours(kind: str, tmp_path: Path) -> None:
    """nerfstudio writes bytes with ``ply_color_mode rgb``."""
    rows = np.array(_vertices(tmp_path).data)
    kept = [name for name in rows.dtype.names or () if name[:2] != "f_"]
    made = np.zeros(
        len(rows), [(name, "f4") for name in kept] + [(c, kind) for c in ("red", "green", "blue")]
    )
    for name in kept:
        made[name] = rows[name]
    made["green"] = 204 if kind == "u1" else 0.8
    plyfile.PlyData([plyfile.PlyElement.describe(made, "vertex")]).write(str(tmp_path / "a.ply"))
    sh = read_scene(tmp_path / "a.ply").gaussians.sh
    assert sh.shape[1] == 1
    expected = (torch.tensor([0.0, 0.8, 0.0]) - 0.5) / SH_C0
    assert torch.allclose(sh[:, 0], expected.expand(len(rows), 3), atol=1e-5)


def test_infinite_opacities_of_other_programs_are_read(tmp_path: Path) -> None:
    """splat-transform writes them for the opacities 0 and 255 of packed formats."""
    made = scene(0)
    made.gaussians.logit_opacities[:2] = torch.tensor([np.inf, -np.inf])
    write_ply(tmp_path / "a.ply", made)
    assert read_ply(tmp_path / "a.ply").gaussians.logit_opacities[:2].tolist() == [OPAQUE, -OPAQUE]


def old_spz(version: int, count: int = 20) -> tuple[bytes, np.ndarray, np.ndarray]:
    """Return a file of version 1 or 2, as load-spz.cc has it; its positions; its quaternions x y z w."""
    chance = np.random.default_rng(version)
    means = chance.normal(size=(count, 3)).astype(np.float16).astype(np.float64)
    quaternions = chance.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True) * np.sign(quaternions[:, 3:])
    fixed = np.rint(means * 4096).astype("<i4").view(np.uint8).reshape(count, 3, 4)[..., :3]
    positions = means.astype("<f2").tobytes() if version == 1 else fixed.tobytes()
    columns = [
        positions,
        np.full(count, 128, np.uint8).tobytes(),
        np.full((count, 3), 200, np.uint8).tobytes(),
        np.full((count, 3), 80, np.uint8).tobytes(),
        np.rint((quaternions[:, :3] + 1) * 127.5).astype(np.uint8).tobytes(),
        np.full((count, 9), 130, np.uint8).tobytes(),
    ]
    header = struct.pack("<IIIBBBB", 0x5053474E, version, count, 1, 12, 1, 0)
    return gzip.compress(header + b"".join(columns)), means, quaternions


@pytest.mark.parametrize("version", [1, 2])
def test_old_versions_of_spz(version: int) -> None:
    content, means, quaternions = old_spz(version)
    found = from_spz(content)
    gaussians = found.gaussians
    assert found.antialias and gaussians.sh_degree == 1
    assert np.abs(gaussians.means.numpy() - means).max() < 1 / 4096
    assert (
        np.abs((gaussians.rotations.numpy() * quaternions[:, [3, 0, 1, 2]]).sum(axis=1)).min() > 0.995
    )  # 8 bits each
    assert torch.allclose(gaussians.log_scales, torch.tensor(-5.0))
    assert torch.allclose(gaussians.sh[:, 1:], torch.tensor(2 / 128))


def damaged(kind: str) -> list[Callable[[bytes], bytes]]:
    return [
        lambda data: b"",
        lambda data: data[:30],
        lambda data: data[: len(data) * 2 // 3],
        lambda data: b"x" * 99,
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file_of_another_program_names_what_is_read(kind: str, tmp_path: Path) -> None:
    """The hint was to repeat the stage that wrote it, although no stage had."""
    path = tmp_path / f"a.{kind}"
    write_scene(path, scene(1), kind)
    whole = path.read_bytes()
    for damage in damaged(kind):
        path.write_bytes(damage(whole))
        with pytest.raises(StoreError, match=r"cannot read the scene") as caught:
            read_scene(path)
        assert "give Gaussians" in caught.value.hint and "stage" not in caught.value.hint


def test_a_damaged_file_of_a_stage_names_the_stage(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text("{}")
    (tmp_path / "scene.ply").write_bytes(b"ply\n")
    with pytest.raises(StoreError) as caught:
        read_ply(tmp_path / "scene.ply")
    assert "repeat the stage" in caught.value.hint


@pytest.mark.parametrize("degree", [4, 5])
def test_higher_degrees_are_refused(degree: int, tmp_path: Path) -> None:
    content, _, _ = old_spz(2)
    raw = bytearray(gzip.decompress(content))
    raw[12] = degree
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(raw)))
    with pytest.raises(CleargsError, match=f"degree {degree}"):
        read_scene(tmp_path / "a.spz")
