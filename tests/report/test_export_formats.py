"""``cleargs export`` of a whole run: coordinates, endings, and existing files."""

from __future__ import annotations

import json
import math
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_model import POINTS_XYZ, write_no_formation, write_sparse
from report_run import FinishedRun

from cleargs.capture.model import read_model
from cleargs.capture.tables import load_frames
from cleargs.cli.main import invoke
from cleargs.errors import InputError
from cleargs.named_views import keep_views
from cleargs.render import pruning
from cleargs.scene.measure import ViewPsnr
from cleargs.scene.views import camera_of
from cleargs.splat.camera import Camera
from cleargs.splat.compressed_ply import compressed_ply, morton_order
from cleargs.splat.formats import FORMATS
from cleargs.splat.ply import read_ply
from cleargs.splat.transforms import sh_basis


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    run = FinishedRun(tmp_path_factory.mktemp("export"))
    write_sparse(run.folder / "ingest")
    write_no_formation(run.folder / "consolidate")
    return run


def export(run: FinishedRun, output: Path, *arguments: str) -> int:
    return invoke(["export", str(run.folder), "-o", str(output), "--cameras", *arguments])


@pytest.mark.parametrize("kind", [kind for kind in FORMATS if kind != "usdc"])
def test_every_format_in_both_worlds(run: FinishedRun, kind: str, tmp_path: Path) -> None:
    assert export(run, tmp_path / f"here.{kind}") == 0
    assert export(run, tmp_path / f"there.{kind}", "--world", "input") == 0
    here, there = ((tmp_path / f"{name}.{kind}").read_bytes() for name in ("here", "there"))
    assert here != there
    cameras = [json.loads((tmp_path / f"{name}.cameras.json").read_text()) for name in ("here", "there")]
    assert len(cameras[0]) == 6  # the placed frames
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the similarity of the run
    moved = 2.5 * turn @ cameras[0][2]["position"] + [1.0, -2.0, 3.0]
    assert np.allclose(cameras[1][2]["position"], moved)
    models = [read_model(tmp_path / f"{name}.colmap/sparse/0") for name in ("here", "there")]
    assert np.allclose(models[1].images[3].pose.centre, moved) and len(models[1].images) == 6
    assert np.allclose(models[1].xyz, 2.5 * models[0].xyz @ turn.T + [1.0, -2.0, 3.0])
    assert np.allclose(models[0].xyz, POINTS_XYZ)


def test_degree_three_for_the_inria_code(run: FinishedRun, tmp_path: Path) -> None:
    assert export(run, tmp_path / "a.ply", "--sh-degree", "3") == 0
    assert read_ply(tmp_path / "a.ply").gaussians.sh_degree == 3
    assert export(run, tmp_path / "b.ply", "--sh-degree", "0") == 2 and not (tmp_path / "b.ply").exists()


def test_nothing_is_overwritten_unasked(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.ply").write_text("mine")
    assert export(run, tmp_path / "a.ply") == 2 and "give --force" in capsys.readouterr().err
    assert (tmp_path / "a.ply").read_text() == "mine" and not (tmp_path / "a.cameras.json").exists()
    assert export(run, tmp_path / "a.ply", "--force") == 0
    (tmp_path / "a.cameras.json").write_text("mine")
    (tmp_path / "a.ply").unlink()
    assert export(run, tmp_path / "a.ply") == 2 and "of another export" in capsys.readouterr().err
    assert (tmp_path / "a.cameras.json").read_text() == "mine" and not (tmp_path / "a.ply").exists()


def test_a_second_export_next_to_a_first(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Once, the cameras of the first export made the second one fail."""
    assert export(run, tmp_path / "a.ply") == 0
    assert capsys.readouterr().out.splitlines()[0].strip(), "scripts read the first line"
    assert export(run, tmp_path / "a.sog") == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.cameras.json",
        "a.colmap",
        "a.ply",
        "a.sog",
    ]
    given = ["export", str(run.folder), "-o", str(tmp_path / "b.ply"), "-o", str(tmp_path / "b.spz")]
    assert invoke(given) == 0
    assert not (tmp_path / "b.cameras.json").exists() and not (tmp_path / "b.colmap").exists()
    assert read_ply(tmp_path / "b.ply").gaussians.num == 4000 and (tmp_path / "b.spz").stat().st_size > 4000


@pytest.mark.parametrize("program", ["blender", "unreal", "unity", "supersplat", "web"])
def test_a_program_chooses_format_and_axes(
    run: FinishedRun, program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert invoke(["export", str(run.folder), "--for", program]) == 0
    (file,) = tmp_path.iterdir()
    assert file.suffix == {"supersplat": ".sog", "web": ".spz"}.get(program, ".ply")
    if file.suffix != ".ply":
        return
    scene = read_ply(file).gaussians
    assert scene.sh_degree == 3  # Blender and the game engines read no other degree
    ahead, axis = {"blender": (1, 1), "unity": (-1, 2), "unreal": (1, 2)}[program]
    assert float((ahead * scene.means[:, axis]).median()) > 0.5  # the wall is ahead of the first camera


def test_a_packed_run_can_be_exported_elsewhere(run: FinishedRun, tmp_path: Path) -> None:
    assert invoke(["pack", str(run.folder), "-o", str(tmp_path / "room.zip")]) == 0
    with zipfile.ZipFile(tmp_path / "room.zip") as archive:
        assert not any("candidates" in name or "/images/" in name for name in archive.namelist())
        archive.extractall(tmp_path)
    copy = tmp_path / run.folder.name
    assert not [path for path in copy.rglob("*") if path.is_symlink()]
    settings = (copy / "run.toml").read_text()
    assert str(run.folder.parent) not in settings and "input = " in settings
    assert invoke(["show", str(copy)]) == 0
    for where, name in ((run.folder, "here"), (copy, "there")):
        assert invoke(["export", str(where), "-o", str(tmp_path / f"{name}.ply"), "--up", "z"]) == 0
    assert (tmp_path / "here.ply").read_bytes() == (tmp_path / "there.ply").read_bytes()
    assert invoke(["pack", str(run.folder), "-o", str(tmp_path / "room.zip")]) == 2


def test_metres(run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def positions(*more: str) -> np.ndarray:
        assert export(run, tmp_path / "a.ply", "--force", *more) == 0
        return np.array([one["position"] for one in json.loads((tmp_path / "a.cameras.json").read_text())])

    plain, numbers = positions(), sorted(read_model(tmp_path / "a.colmap/sparse/0").images)
    for more in ([], ["--world", "input"], ["--up", "z"]):
        scaled = positions("--metres", f"{numbers[0] - 1}-{numbers[2] - 1}=3.5", *more)
        assert np.linalg.norm(scaled[0] - scaled[2]) == pytest.approx(3.5)
    assert "in metres (a unit of the run is" in capsys.readouterr().out
    shape = np.linalg.norm(plain - plain[0], axis=1) / np.linalg.norm(plain[2] - plain[0])
    assert np.allclose(np.linalg.norm(scaled - scaled[0], axis=1) / 3.5, shape)
    for wrong in ("0-999=2", "0=2", "0-1=0"):
        assert export(run, tmp_path / "b.ply", "--metres", wrong) == 2
        assert "FRAME-FRAME=METRES" in capsys.readouterr().err


@pytest.mark.parametrize("options", [["--up", "y", "--metres", "0-5=30"], ["--world", "input"]])
def test_a_compressed_ply_is_rounded_for_the_cameras(
    run: FinishedRun, options: list[str], tmp_path: Path
) -> None:
    assert export(run, tmp_path / "a.ply", *options) == 0
    assert export(run, tmp_path / "b.compressed.ply", *options) == 0
    scene, back = read_ply(tmp_path / "a.ply"), read_ply(tmp_path / "b.compressed.ply").gaussians.sh
    (tmp_path / "c.compressed.ply").write_bytes(compressed_ply(scene))  # for no cameras
    plain = read_ply(tmp_path / "c.compressed.ply").gaussians.sh
    cameras = json.loads((tmp_path / "a.cameras.json").read_text())
    eyes = torch.tensor([camera["position"] for camera in cameras], dtype=torch.float64)
    made = scene.gaussians.select(torch.from_numpy(morton_order(scene.gaussians.means.numpy())))
    basis = sh_basis(torch.nn.functional.normalize(made.means[:, None] - eyes, dim=2), made.sh.shape[1])
    errors = [
        torch.einsum("nmk,nkc->nmc", basis, (sh - made.sh).double()).square().mean() for sh in (back, plain)
    ]
    assert errors[0] < 0.2 * errors[1]


def test_an_unknown_ending_writes_nothing(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(run, tmp_path / "room.splat") == 2
    assert ".compressed.ply" in capsys.readouterr().err and not list(tmp_path.iterdir())


def numbers(capsys: pytest.CaptureFixture[str], pattern: str) -> list[float]:
    """The numbers in the output that the groups of ``pattern`` match."""
    found = re.search(pattern, capsys.readouterr().out)
    assert found is not None
    return [float(number) for number in found.groups()]


PRUNED = r"pruned (\d+) of 4000 Gaussians; PSNR of 5 training frames ([\d.]+) -> ([\d.]+) dB"


def test_pruning_reports_its_cost(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of the wall is outside all views. A threshold of many pixels removes most of the rest."""
    assert export(run, tmp_path / "a.ply", "--prune", "contribution:0.0001") == 0
    gone, before, after = numbers(capsys, PRUNED)
    assert gone > 1000 and before == after  # invisible Gaussians do not change the PSNR
    assert read_ply(tmp_path / "a.ply").gaussians.num == 4000 - gone
    assert export(run, tmp_path / "b.ply", "--prune", "contribution:20") == 0
    more, same, worse = numbers(capsys, PRUNED)
    assert more > gone and same == before and worse < before - 1.0
    assert export(run, tmp_path / "c.ply", "--prune", "opacity:0.9", "--prune", "contribution:0.0001") == 0
    both, _, _ = numbers(capsys, PRUNED)
    kept = read_ply(tmp_path / "c.ply").gaussians
    assert both > gone and float(torch.sigmoid(kept.logit_opacities).min()) >= 0.9


def test_a_frame_without_a_pixel_that_counts_is_not_in_the_psnr_of_pruning(
    run: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    psnr = iter([math.inf, 30.0, 30.0, 30.0, 30.0, math.inf, 20.0, 20.0, 20.0, 20.0])
    monkeypatch.setattr(pruning, "evaluate_views", lambda *views, **options: [ViewPsnr(next(psnr), None)])
    assert export(run, tmp_path / "a.ply", "--prune", "opacity:0.1") == 0
    assert numbers(capsys, PRUNED)[1:] == [30.0, 20.0]


def test_a_sphere_is_dropped_and_the_box_of_the_scene_shown(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    means = read_ply(run.folder / "consolidate/scene.ply").gaussians.means
    centre = ",".join(f"{x:.6f}" for x in means[7].tolist())
    assert export(run, tmp_path / "d.ply", "--drop", f"sphere:{centre},0.01") == 0
    (gone,) = numbers(capsys, r"dropped (\d+) Gaussians")
    left = read_ply(tmp_path / "d.ply").gaussians.means
    assert len(left) == len(means) - int(gone) and (left - means[7]).norm(dim=1).min() > 0.01
    assert invoke(["show", str(run.folder), "scene", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["low"] == means.amin(0).tolist() and facts["high"] == means.amax(0).tolist()
    assert export(run, tmp_path / "e.ply", "--crop", "box:50,50,50,51,51,51") == 2
    box = ",".join(f"{x:.4g}" for x in facts["low"] + facts["high"])
    assert f"the scene is in box:{box}, its 1 to 99 % in box:" in capsys.readouterr().err


def test_a_crop_uses_the_coordinates_of_the_cameras(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(run, tmp_path / "a.ply", "--crop", "box:-1,-1,0,1,1,2") == 0
    means = read_ply(tmp_path / "a.ply").gaussians.means
    (gone,) = numbers(capsys, r"cropped to the box -1,-1,0,1,1,2: (\d+) of 4000 Gaussians are outside")
    assert 0 < len(means) == 4000 - gone and float(means.abs().max()) <= 2.0
    assert export(run, tmp_path / "b.ply", "--crop", "percentile:80", "--world", "input") == 0
    kept = read_ply(tmp_path / "b.ply").gaussians.num
    assert 0.45 * 4000 < kept < 0.6 * 4000  # 0.8 along each of three independent axes


@pytest.mark.parametrize("kind", ["ply", "spz"])
def test_up(run: FinishedRun, kind: str, tmp_path: Path) -> None:
    """The first frame's camera at the origin, looking along -z with y up, in scene, cameras and model."""
    assert export(run, tmp_path / f"a.{kind}", "--up", "y") == 0
    first = json.loads((tmp_path / "a.cameras.json").read_text())[0]
    assert np.allclose(first["position"], 0.0) and np.allclose(np.array(first["rotation"])[:, 2], [0, 0, -1])
    model = read_model(tmp_path / "a.colmap/sparse/0")
    assert np.allclose(model.images[1].pose.centre, 0.0) and (model.xyz[:, 2] < -1.0).all()
    if kind == "ply":
        means = read_ply(tmp_path / "a.ply").gaussians.means
    else:
        means = torch.from_numpy(pytest.importorskip("gsply.spz").read_spz(str(tmp_path / "a.spz")).means)
    assert float(means[:, 2].max()) < -1.0  # the wall is ahead, not behind


@pytest.mark.parametrize(
    ("name", "options", "cause"),
    [
        ("a.ply", ("--up", "z", "--world", "input"), "--up"),
        ("a.glb", ("--up", "z"), "y is always up"),
        ("a.ply", ("--prune", "opacity"), "--prune opacity"),
        ("a.ply", ("--prune", "size:1"), "--prune size:1"),
        ("a.ply", ("--prune", "opacity:0.1", "--prune", "opacity:0.2"), "--prune opacity:0.2"),
        ("a.ply", ("--prune", "contribution:nan"), "--prune contribution:nan"),
        ("a.ply", ("--prune", "opacity:1"), "no Gaussian is left"),
        ("a.ply", ("--crop", "box:1,1,1,0,0,0"), "--crop box"),
        ("a.ply", ("--crop", "percentile:101"), "--crop percentile"),
        ("a.ply", ("--crop", "box:50,50,50,51,51,51"), "no Gaussian is left"),
        ("a.ply", ("--drop", "sphere:0,0,0"), "--drop sphere"),
        ("a.ply", ("--drop", "sphere:50,50,50,1"), "no Gaussian is in the sphere"),
    ],
)
def test_what_cannot_be_meant_is_refused(
    run: FinishedRun,
    name: str,
    options: tuple[str, ...],
    cause: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert export(run, tmp_path / name, *options) == 2 and not list(tmp_path.iterdir())
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith(("error", "hint"))]
    assert len(said) == 2 and cause in said[0]


def test_named_views_go_to_web_pages(
    run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(run, tmp_path / "none.spz", "--for", "web") == 0
    assert not (tmp_path / "none.views.json").exists()
    keep_views(run.folder, ["start=0,0,-1,0,0,1", "gone=0,0,0,1,1,1", "gone="])
    try:
        assert export(run, tmp_path / "a.spz", "--for", "web", "--cameras") == 0
    finally:
        (run.folder / "views.json").unlink()
    (view,) = json.loads((tmp_path / "a.views.json").read_text())
    first = json.loads((tmp_path / "a.cameras.json").read_text())[0]
    turn = np.array(first["rotation"]) @ camera_of_first(run).world_to_camera[:3, :3]
    assert view["name"] == "start"
    assert np.allclose(np.subtract(view["target"], view["position"]), turn @ [0, 0, 2], atol=1e-6)
    assert np.allclose(view["up"], turn @ [0, -1, 0], atol=1e-6)
    for wrong in ("x", "x=1,2,3", "=0,0,0,1,1,1", "x=0,0,0,0,0,0"):
        with pytest.raises(InputError, match="--view"):
            keep_views(run.folder, [wrong])


def camera_of_first(run: FinishedRun) -> Camera:
    return camera_of(next(frame for frame in load_frames(run.folder / "ingest") if frame.registered))
