"""Exported scenes, read by PlayCanvas's splat-transform and Khronos's glTF validator (`make oracles`)."""

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
from cleargs.splat.formats import write_scene

PACKAGES = Path(__file__).parents[2] / ".oracles/node_modules"
pytestmark = pytest.mark.skipif(
    shutil.which("node") is None or not PACKAGES.is_dir(),
    reason="npm's packages are not installed (make oracles)",
)

VALIDATE = """
const {readFileSync} = require('fs');
require('gltf-validator').validateBytes(new Uint8Array(readFileSync(process.argv[1])))
    .then((report) => console.log(JSON.stringify(report.issues.messages)));
"""


@pytest.mark.parametrize("kind", ["ply", "compressed.ply", "sog", "spz"])
@pytest.mark.parametrize("sh_degree", [1, 3])
def test_splat_transform_finds_the_same_scene(kind: str, sh_degree: int, tmp_path: Path) -> None:
    made = scene(sh_degree)
    write_scene(tmp_path / f"a.{kind}", made, kind)
    command = ["node", str(PACKAGES / "@playcanvas/splat-transform/bin/cli.mjs"), "-q"]
    subprocess.run([*command, str(tmp_path / f"a.{kind}"), str(tmp_path / "back.ply")], check=True)
    back = pytest.importorskip("gsply").plyread(str(tmp_path / "back.ply"))
    order = np.arange(made.gaussians.num)
    if kind in ("sog", "compressed.ply"):
        order = morton_order(made.gaussians.means.numpy())
    # It assumes that .spz files have the axes of .ply files.
    signs = ABOUT_X if kind == "spz" else np.ones(3)
    expected = made.gaussians.select(torch.from_numpy(order))
    within = 0.02 if kind == "compressed.ply" else 2e-3  # half a step of 10 bits over a range of 30
    assert_turned(gaussians(back), expected, signs, sh_within=0.06, means_within=within)


def test_gltf_validator_reports_only_the_extension(tmp_path: Path) -> None:
    write_scene(tmp_path / "a.glb", scene(3), "glb")
    command = ["node", "-e", VALIDATE, str(tmp_path / "a.glb")]
    done = subprocess.run(command, cwd=PACKAGES, check=True, capture_output=True, text=True)
    messages = json.loads(done.stdout)
    # The attributes of KHR_gaussian_splatting have names that glTF without the extension does not allow.
    assert {message["code"] for message in messages} == {
        "UNSUPPORTED_EXTENSION",
        "MESH_PRIMITIVE_INVALID_ATTRIBUTE",
    }
    assert all("KHR_gaussian_splatting" in message["message"] + message["pointer"] for message in messages)
