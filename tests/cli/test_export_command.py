"""``cleargs export``: errors and files."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.append(str(Path(__file__).parents[1] / "evaluate"))

import eval_world
from colmap_model import write_sparse
from eval_world import cameras, make_scene, write_run

from cleargs.cli.main import invoke
from cleargs.errors import InputError
from cleargs.render.pruning import crop_scene, drop_spheres
from cleargs.splat.formats import padded, read_scene
from cleargs.splat.ply import read_ply


@pytest.fixture
def run(tmp_path: Path) -> Path:
    run = write_run(tmp_path / "run", make_scene(count=20), cameras())
    write_sparse(run / "ingest")
    return run


def export(run: Path, output: Path, *more: str) -> int:
    return invoke(["export", str(run), "-o", str(output), "--cameras", *more])


def test_the_ending_chooses_the_format(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("x.splat", "x", "x.ply.gz"):
        assert export(run, tmp_path / name) == 2 and not (tmp_path / name).exists()
        cause, remedy = capsys.readouterr().err.splitlines()
        assert "not a known scene format" in cause and ".ply" in remedy
    assert export(run, tmp_path / "x.PLY") == 0
    assert read_ply(tmp_path / "x.PLY").gaussians.num == 20


def test_an_existing_file_stays_without_force(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.ply").write_text("mine")
    assert export(run, tmp_path / "mine.ply") == 2 and (tmp_path / "mine.ply").read_text() == "mine"
    assert "exists already" in capsys.readouterr().err
    assert export(run, tmp_path / "mine.ply", "--force") == 0
    assert read_ply(tmp_path / "mine.ply").gaussians.num == 20


def test_a_stage_without_a_scene_is_named(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(run, tmp_path / "x.ply", "--stage", "rva") == 2
    cause, remedy = capsys.readouterr().err.splitlines()
    assert "rva has no scene" in cause and "g0" in remedy


@pytest.mark.parametrize(("quality", "made_by"), [("draft", "g0"), ("standard", "consolidate")])
def test_a_scene_is_named_after_the_stage_that_made_it(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], quality: str, made_by: str
) -> None:
    """A draft has no stage after g0: they hand its scene on."""
    shutil.copytree(run / "g0", run / "consolidate")
    settings = (run / "run.toml").read_text()
    (run / "run.toml").write_text(settings.replace('quality = "standard"', f'quality = "{quality}"'))
    assert export(run, tmp_path / "x.ply") == 0
    assert f"scene of {made_by}, " in capsys.readouterr().out
    assert invoke(["show", str(run), "scene"]) == 0
    assert f"scene of {made_by}: 20 Gaussians" in capsys.readouterr().out


def test_a_sphere_around_everything_names_the_extent() -> None:
    with pytest.raises(InputError, match="all Gaussians are in the sphere 0,0,0,1e") as caught:
        drop_spheres(make_scene(count=5), [(0.0, 0.0, 0.0, 1e6)])
    assert "the scene is in box:" in caught.value.hint


def test_a_scene_that_was_turned_says_so(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(run, tmp_path / "x.ply", "--upright", "1,0,0") == 0
    assert "-y is up" in (said := capsys.readouterr().out) and "normalised world" not in said


def test_nothing_left_to_crop_is_an_error() -> None:
    """This happens for example after ``--prune opacity:1``."""
    scene = make_scene(count=5)
    empty = replace(scene, gaussians=scene.gaussians.select(torch.zeros(5, dtype=torch.bool)))
    for region in ((98.0,), (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)):
        with pytest.raises(InputError, match="no Gaussian is left"):
            crop_scene(empty, region)


def test_a_ply_of_a_low_degree_names_the_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Some viewers read degree 3 and degree 0 only, and show a scene of degree 1 without its colours."""
    run = write_run(tmp_path / "low", padded(make_scene(count=20), 1), cameras())
    write_sparse(run / "ingest")
    assert export(run, tmp_path / "low.ply") == 0
    assert "degree 1" in (said := capsys.readouterr().out) and "--sh-degree 3" in said
    assert export(run, tmp_path / "full.ply", "--sh-degree", "3") == 0
    assert "--sh-degree" not in capsys.readouterr().out
    assert [read_ply(tmp_path / name).gaussians.sh_degree for name in ("low.ply", "full.ply")] == [1, 3]


def test_map_coordinates_keep_their_precision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the millions of metres of a map grid, single precision has steps of half a metre."""
    utm = np.array([583960.0, 5402812.0, 412.0])
    monkeypatch.setattr(eval_world, "WORLD", replace(eval_world.WORLD, origin=eval_world.WORLD.origin + utm))
    run = write_run(tmp_path / "far", make_scene(count=20), cameras())
    write_sparse(run / "ingest")
    assert export(run, tmp_path / "x.ply", "--world", "input") == 0
    assert "x.offset.json" in capsys.readouterr().out
    offset = np.array(json.loads((tmp_path / "x.offset.json").read_text())["offset"])
    assert np.abs(offset - utm).max() < 10
    near = read_ply(tmp_path / "x.ply").gaussians
    assert float(near.means.abs().max()) < 100 and len(near.means[:, 0].unique()) == 20
    first = json.loads((tmp_path / "x.cameras.json").read_text())[0]["position"]
    assert np.abs(first).max() < 100  # all files share the offset


def test_a_file_of_another_program_is_exported(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Such a file has no run, so no cameras."""
    assert invoke(["export", str(run), "-o", str(tmp_path / "x.sog")]) == 0
    assert invoke(["export", str(tmp_path / "x.sog"), "-o", str(tmp_path / "y.ply"), "--up", "y"]) == 0
    assert "scene of x.sog" in capsys.readouterr().out
    own, turned = read_scene(tmp_path / "x.sog").gaussians, read_ply(tmp_path / "y.ply").gaussians
    assert torch.allclose(turned.means, own.means * torch.tensor([1.0, -1.0, -1.0]), atol=1e-5)
    for wrong in (["--metres", "0-1=2"], ["--world", "input"], ["--prune", "opacity:0.1"], ["--cameras"]):
        assert invoke(["export", str(tmp_path / "x.sog"), "-o", str(tmp_path / "z.ply"), *wrong]) == 2
        assert "need the cameras of a run" in capsys.readouterr().err
    assert invoke(["export", str(tmp_path / "x.sog"), "-o", str(tmp_path / "z.ply"), "--stage", "g0"]) == 2
    assert "leave it out for a file" in capsys.readouterr().err
    before = (tmp_path / "x.sog").read_bytes()
    assert invoke(["export", str(tmp_path / "x.sog"), "-o", str(tmp_path / "x.sog"), "--force"]) == 2
    assert (tmp_path / "x.sog").read_bytes() == before


def test_a_file_that_is_no_scene_names_what_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x.spz").write_bytes(b"no scene")
    assert invoke(["export", str(tmp_path / "x.spz"), "-o", str(tmp_path / "y.ply")]) != 0
    cause, remedy = capsys.readouterr().err.splitlines()
    assert "cannot read the scene" in cause and ".compressed.ply" in remedy and "stage" not in remedy


def test_playcanvas_gets_version_4_of_spz(run: Path, tmp_path: Path) -> None:
    """Its engine refuses version 3; the others read only that."""
    for arguments, start in (
        (["--for", "playcanvas"], b"NGSP\x04"),
        (["--for", "web"], b"\x1f\x8b"),
        (["--for", "web", "--spz", "4"], b"NGSP\x04"),
        ([], b"\x1f\x8b"),
    ):
        path = tmp_path / "x.spz"
        assert invoke(["export", str(run), "-o", str(path), "--force", *arguments]) == 0
        assert path.read_bytes().startswith(start)


def test_what_a_format_loses_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Anti-aliasing was lost without a word, and a small world destroyed."""
    run = write_run(tmp_path / "aa", replace(make_scene(count=20), antialias=True), cameras())
    write_sparse(run / "ingest")
    assert invoke(["export", str(run), "-o", str(tmp_path / "x.glb")]) == 0
    assert "anti-aliased" in capsys.readouterr().out
    assert invoke(["export", str(run), "-o", str(tmp_path / "x.sog"), "-o", str(tmp_path / "x.spz")]) == 0
    assert "anti-aliased" not in capsys.readouterr().out
    assert invoke(["export", str(run), "-o", str(tmp_path / "y.spz"), "--metres", "0-1=0.00001"]) == 2
    cause, remedy = capsys.readouterr().err.splitlines()
    assert "cannot hold" in cause and ".sog" in remedy and not (tmp_path / "y.spz").exists()


@pytest.mark.parametrize(
    ("side", "axis"), [("top", [0, -1, 0]), ("left", [-1, 0, 0]), ("right", [1, 0, 0]), ("bottom", [0, 1, 0])]
)
@pytest.mark.parametrize("up", [None, "z"])
def test_the_side_of_a_picture_is_turned_up(
    run: Path, tmp_path: Path, side: str, axis: list[int], up: str | None
) -> None:
    assert export(run, tmp_path / "a.ply", "--upright", f"2:{side}", *(["--up", up] if up else [])) == 0
    stood = json.loads((tmp_path / "a.cameras.json").read_text())
    assert np.allclose(np.array(stood[2]["rotation"]) @ axis, [0, 0, 1] if up else [0, -1, 0], atol=1e-6)
    assert not up or np.allclose(stood[0]["position"], 0, atol=1e-6)


def test_a_direction_is_turned_up(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export(run, tmp_path / "a.ply") == 0 and export(run, tmp_path / "b.ply", "--upright", "0,0,2") == 0
    before, after = (
        np.array([camera["rotation"] for camera in json.loads((tmp_path / f"{n}.cameras.json").read_text())])
        for n in "ab"
    )
    turn = after[0] @ before[0].T
    assert np.allclose(turn @ [0, 0, 1], [0, -1, 0], atol=1e-6) and np.allclose(
        after, turn @ before, atol=1e-6
    )
    assert (
        invoke(["export", str(tmp_path / "a.ply"), "-o", str(tmp_path / "c.ply"), "--upright", "0,0,2"]) == 0
    )
    assert np.allclose(
        read_ply(tmp_path / "b.ply").gaussians.means, read_ply(tmp_path / "c.ply").gaussians.means, atol=1e-5
    )
    for wrong in ("99:top", "0:up", "0,0,0", "1,2", "nan,0,1"):
        capsys.readouterr()
        assert export(run, tmp_path / "d.ply", "--upright", wrong) == 2
        assert "--upright" in capsys.readouterr().err
