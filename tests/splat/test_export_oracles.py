"""Exported scenes, read by the formats' own programs and validators (`make oracles`)."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from test_formats import ABOUT_X, assert_turned, gaussians, scene

from cleargs.splat.compressed_ply import morton_order
from cleargs.splat.formats import padded, read_scene, write_scene
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.ply import read_ply

PACKAGES = Path(__file__).parents[2] / ".oracles/node_modules"
needs_npm = pytest.mark.skipif(
    shutil.which("node") is None or not PACKAGES.is_dir(),
    reason="npm's packages are not installed (make oracles)",
)

VALIDATE = """
const {readFileSync} = require('fs');
require('gltf-validator').validateBytes(new Uint8Array(readFileSync(process.argv[1])))
    .then((report) => console.log(JSON.stringify(report.issues.messages)));
"""

DECODE = """
import createSpz from '@adobe/spz';
import {readFileSync} from 'fs';
console.log = console.error; // the library prints to it
const spz = await createSpz();
const found = spz.loadSpzFromBuffer(readFileSync(process.argv[1]), {to: spz.CoordinateSystem.RDF});
const finite = (value) => Math.max(-99, Math.min(99, value)); // JSON has no infinity
const names = ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'];
process.stdout.write(JSON.stringify({
    ...Object.fromEntries(names.map((name) => [name, Array.from(found[name], finite)])),
    antialiased: found.antialiased,
}));
"""


def splat_transform(*arguments: Path | str) -> None:
    command = ["node", str(PACKAGES / "@playcanvas/splat-transform/bin/cli.mjs"), "-q", "-g", "cpu"]
    subprocess.run([*command, *map(str, arguments)], check=True)


@needs_npm
@pytest.mark.parametrize(
    ("kind", "spz_version"), [("ply", 3), ("compressed.ply", 3), ("sog", 3), ("spz", 3), ("spz", 4)]
)
@pytest.mark.parametrize("sh_degree", [1, 3])
def test_splat_transform_finds_the_same_scene(
    kind: str, sh_degree: int, spz_version: int, tmp_path: Path
) -> None:
    made = scene(sh_degree)
    write_scene(tmp_path / f"a.{kind}", made, kind, spz_version=spz_version)  # type: ignore[arg-type]
    splat_transform(tmp_path / f"a.{kind}", tmp_path / "back.ply")
    back = pytest.importorskip("gsply").plyread(str(tmp_path / "back.ply"))
    order = np.arange(made.gaussians.num)
    if kind in ("sog", "compressed.ply"):
        order = morton_order(made.gaussians.means.numpy())
    # It assumes that .spz files have the axes of .ply files.
    signs = ABOUT_X if kind == "spz" else np.ones(3)
    expected = made.gaussians.select(torch.from_numpy(order))
    within = 0.02 if kind == "compressed.ply" else 2e-3  # half a step of 10 bits over a range of 30
    assert_turned(gaussians(back), expected, signs, sh_within=0.06, means_within=within)
    assert read_ply(tmp_path / "back.ply").antialias  # it keeps the comment, or the flag, of every format


@needs_npm
@pytest.mark.parametrize("kind", ["compressed.ply", "sog", "spz"])
def test_splat_transform_finds_no_harmonics_in_a_padded_scene(kind: str, tmp_path: Path) -> None:
    made = padded(scene(1), 3)
    write_scene(tmp_path / f"a.{kind}", made, kind)
    splat_transform(tmp_path / f"a.{kind}", tmp_path / "back.ply")
    sh = read_ply(tmp_path / "back.ply").gaussians.sh
    assert sh.shape[1] == 4 if kind == "compressed.ply" else not sh[:, 4:].abs().gt(1e-6).any()


@needs_npm
@pytest.mark.parametrize("name", ["sog", "compressed.ply", "3.spz", "4.spz", "glb"])
def test_the_files_of_splat_transform_are_read(name: str, tmp_path: Path) -> None:
    made = scene(3)
    write_scene(tmp_path / "a.ply", made, "ply")
    target, version = tmp_path / f"b.{name}", ["--spz-version", name[0]] if name[0].isdigit() else []
    splat_transform(*version, tmp_path / "a.ply", target)
    splat_transform(target, tmp_path / "back.ply") if name != "glb" else write_scene(
        tmp_path / "back.ply", made, "ply"
    )
    expected, found = read_ply(tmp_path / "back.ply").gaussians, read_scene(target).gaussians
    signs = ABOUT_X if name.endswith("spz") else np.ones(3)  # it writes the axes of the .ply into .spz
    assert_turned(found, expected, signs, sh_within=1e-3 if name != "sog" else 2e-3, means_within=1e-3)
    assert read_scene(target).antialias == (name != "glb")


@needs_npm
@pytest.mark.parametrize("spz_version", [3, 4])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_the_makers_library_decodes_spz(spz_version: int, sh_degree: int, tmp_path: Path) -> None:
    made = scene(sh_degree)
    write_scene(tmp_path / "a.spz", made, "spz", spz_version=spz_version)  # type: ignore[arg-type]
    command = ["node", "--input-type=module", "-e", DECODE, str(tmp_path / "a.spz")]
    done = subprocess.run(command, cwd=PACKAGES, check=True, capture_output=True, text=True)
    found = {name: torch.tensor(values) for name, values in json.loads(done.stdout).items()}
    count = made.gaussians.num
    assert bool(found["antialiased"])
    back = Gaussians(
        means=found["positions"].reshape(count, 3),
        log_scales=found["scales"].reshape(count, 3),
        rotations=found["rotations"].reshape(count, 4)[:, [3, 0, 1, 2]],
        logit_opacities=found["alphas"],
        sh=torch.cat([found["colors"].reshape(count, 1, 3), found["sh"].reshape(count, -1, 3)], dim=1),
    )
    assert_turned(back, made.gaussians, np.ones(3), sh_within=0.01)
    own = read_scene(tmp_path / "a.spz").gaussians
    for name in ("means", "log_scales", "sh"):
        assert torch.allclose(back.tensors()[name], own.tensors()[name], atol=1e-5), name
    assert torch.allclose(back.logit_opacities.sigmoid(), own.logit_opacities.sigmoid(), atol=1e-6)


@needs_npm
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_gltf_validator_reports_only_the_extension(sh_degree: int, tmp_path: Path) -> None:
    made = scene(sh_degree)
    made.gaussians.logit_opacities[:2] = torch.tensor([np.inf, -np.inf])
    write_scene(tmp_path / "a.glb", made, "glb")
    command = ["node", "-e", VALIDATE, str(tmp_path / "a.glb")]
    done = subprocess.run(command, cwd=PACKAGES, check=True, capture_output=True, text=True)
    messages = json.loads(done.stdout)
    # The attributes of KHR_gaussian_splatting have names that glTF without the extension does not allow.
    assert {message["code"] for message in messages} == {
        "UNSUPPORTED_EXTENSION",
        "MESH_PRIMITIVE_INVALID_ATTRIBUTE",
    }
    assert all("KHR_gaussian_splatting" in message["message"] + message["pointer"] for message in messages)


def test_every_validator_of_openusd_is_silent(tmp_path: Path) -> None:
    """Without metersPerUnit, Blender made a room of 8.39 m 0.084 m large, and a validator named the error."""
    pytest.importorskip("pxr.UsdValidation", reason="the extra `usd` is not installed")
    from pxr import Usd, UsdGeom, UsdValidation

    made = scene(2)
    write_scene(tmp_path / "a.usdc", made, "usdc")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []
    assert UsdGeom.StageHasAuthoredMetersPerUnit(stage) and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(stage.GetPseudoRoot())
    low, high = (np.array(corner) for corner in (box.GetRange().GetMin(), box.GetRange().GetMax()))
    means = made.gaussians.means.numpy() * [-1.0, -1.0, 1.0]
    largest = float(made.gaussians.log_scales.exp().max())
    assert (low < means.min(axis=0)).all() and (high > means.max(axis=0)).all()
    assert (low > means.min(axis=0) - 3.01 * largest).all() and (
        high < means.max(axis=0) + 3.01 * largest
    ).all()
    harmonics = stage.GetDefaultPrim().GetAttribute("radiance:sphericalHarmonicsCoefficients")
    assert (harmonics.GetMetadata("elementSize"), harmonics.GetMetadata("interpolation")) == (9, "vertex")
