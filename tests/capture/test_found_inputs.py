"""Inputs as people have them: parts missing, other names, several models or videos, other splits."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial import KDTree

from cleargs.capture.cameras import Similarity
from cleargs.capture.choice import select_sharp_frames
from cleargs.capture.loose_points import LoosePoints, in_scene
from cleargs.capture.model import read_model, write_model
from cleargs.capture.sources import externals, open_capture
from cleargs.capture.tables import load_frames, load_points
from cleargs.errors import InputError, StageError
from cleargs.media.encode import write_video
from cleargs.progress import SilentReporter
from cleargs.stages.ingest import IngestConfig

from .conftest import Ingest, Ingested, camera_to_world, ingest_in, texture
from .test_data_sets import poses_bounds


@pytest.fixture(scope="module")
def found_before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Models of all tests of this file: inputs with the same pictures, poses and points are placed once."""
    return tmp_path_factory.mktemp("kept")


@pytest.fixture
def ingest(tmp_path: Path, found_before: Path) -> Ingest:
    return ingest_in(tmp_path, found_before)


@pytest.fixture
def project(made: Ingested, tmp_path: Path) -> Path:
    """A COLMAP project of ten images: ``images/`` and ``sparse/0``."""
    folder = tmp_path / "project"
    shutil.copytree(made.out / "images", folder / "images")
    shutil.copytree(made.out / "colmap/sparse", folder / "sparse")
    return folder


def part_of_model(model: Path, target: Path, images: int) -> None:
    """Write the first ``images`` images of ``model`` into ``target``."""
    whole = read_model(model)
    kept = dict(sorted(whole.images.items())[:images])
    small = type(whole)(whole.cameras, kept, whole.point_ids[:0], whole.xyz[:0], whole.error[:0])
    small = type(whole)(
        whole.cameras,
        {key: image.select(np.zeros(len(image.xy), bool)) for key, image in kept.items()},
        small.point_ids,
        small.xyz,
        small.error,
    )
    write_model(target, small, np.zeros((0, 3), np.uint8))


# -- COLMAP projects ---------------------------------------------------------------------------------------


def test_the_largest_model_is_taken(project: Path) -> None:
    (project / "sparse/0").rename(project / "sparse/1")
    part_of_model(project / "sparse/1", project / "sparse/0", 4)
    capture = open_capture(project, IngestConfig())
    assert sum(frame.pose is not None for frame in capture.frames) == 10
    assert externals(project, IngestConfig())["sparse"] == project / "sparse/1"
    assert any("sparse/1" in note and "10 images" in note for note in capture.notes)


def test_images_that_are_gone_are_left_out(project: Path, ingest: Ingest) -> None:
    for index in (2, 5, 6):
        (project / f"images/{index:06d}.png").unlink()
    done = ingest(project)
    assert done.result.summary["registered"] == len(load_frames(done.out)) == 7
    assert any("3 of 10 images" in text and "000002.png" in text for text in done.warnings)


def test_most_images_gone_is_refused(project: Path) -> None:
    for index in range(6):
        (project / f"images/{index:06d}.png").unlink()
    with pytest.raises(InputError, match="lists 6 images that do not exist"):
        open_capture(project, IngestConfig())


def rename_all(folder: Path, suffix: str) -> None:
    for path in list(folder.iterdir()):
        path.rename(path.with_suffix(suffix))


@pytest.mark.parametrize("name", ["photos", "images_2", "input", "."])
def test_images_in_a_folder_of_another_name(project: Path, name: str) -> None:
    if name == ".":
        for path in list((project / "images").iterdir()):
            path.rename(project / path.name)
        (project / "images").rmdir()
    else:
        (project / "images").rename(project / name)
    capture = open_capture(project, IngestConfig())
    assert [frame.path for frame in capture.frames] == [project / name / f"{i:06d}.png" for i in range(10)]
    named = externals(project, IngestConfig())
    assert project / name in named.values() or named["beside_sparse"] == {
        path.name: path for path in project.glob("*.png")
    }


def test_images_of_another_suffix_and_case(project: Path, ingest: Ingest) -> None:
    for path in list((project / "images").iterdir()):
        path.rename(path.with_suffix(".PNG"))
    done = ingest(project)
    assert done.result.summary["registered"] == 10
    assert any("by their stems" in text for text in done.warnings)


def test_images_of_another_size_under_their_stems(project: Path, ingest: Ingest) -> None:
    """As Deblur-NeRF's real scenes have them: the model names the reduced ones."""
    for path in list((project / "images").iterdir()):
        cv2.imwrite(str(path.with_suffix(".jpg")), cv2.resize(cv2.imread(str(path)), None, fx=2, fy=2))
        path.unlink()
    done = ingest(project)
    frame = load_frames(done.out)[0]
    assert done.result.summary["registered"] == 10 and frame.width == 640 and np.isclose(frame.fx, 600)


def test_named_images_of_a_reduced_folder(project: Path) -> None:
    (project / "images").rename(project / "images_4")
    shutil.copytree(project / "images_4", project / "images")
    rename_all(project / "images", ".jpg")
    capture = open_capture(project, IngestConfig())
    assert {frame.path.parent.name for frame in capture.frames} == {"images_4"}


def as_text(project: Path) -> Path:
    """Write the model of ``project`` as text, in place of the binary one."""
    folder = project / "sparse/0"
    pycolmap.Reconstruction(folder).write_text(folder)
    for file in folder.glob("*.bin"):
        file.unlink()
    return folder


@pytest.mark.parametrize("form", ["bin", "txt"])
@pytest.mark.parametrize("what", ["no tracks", "no points", "no file of points", "points3D.ply"])
def test_models_without_tracks_are_triangulated(project: Path, ingest: Ingest, form: str, what: str) -> None:
    """As RealityScan, Metashape and programs for laser scanners write them."""
    folder = as_text(project)
    lines = (folder / "images.txt").read_text().splitlines()
    lines = [line if line.startswith("#") or line.endswith("png") else "" for line in lines]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    points = (folder / "points3D.txt").read_text().splitlines()
    bare = [" ".join(line.split()[:8]) for line in points if not line.startswith("#")]
    (folder / "points3D.txt").write_text("\n".join(bare if what == "no tracks" else []) + "\n")
    if form == "bin":
        pycolmap.Reconstruction(folder).write_binary(folder)
        for file in folder.glob("*.txt"):
            file.unlink()
    if what in ("no file of points", "points3D.ply"):
        (folder / f"points3D.{form}").unlink()
    if what == "points3D.ply":
        (folder / "points3D.ply").write_bytes(b"ply\n")
    done = ingest(project)
    assert done.result.summary["registered"] == 10 and done.result.summary["points"] > 100
    assert done.result.summary["poses"] == "given"
    assert any("no two images see" in line for line in done.warnings) == (what == "no tracks")
    table = load_points(done.out)
    loose = table.track_length == 0
    assert (loose.sum() > 0.9 * len(bare)) if what == "no tracks" else not loose.any()
    assert np.unique(table.point_id).size == len(loose) and len(table.observed_rgb) == (~loose).sum()
    assert np.median(KDTree(table.xyz[~loose]).query(table.xyz[loose])[0] if loose.any() else 0) < 0.02


def test_points_of_another_place_start_no_gaussians(project: Path) -> None:
    model = read_model(project / "sparse/0")
    here = Similarity(np.eye(3), np.zeros(3), 1.0)
    assert model.rgb is not None
    loose = LoosePoints(model.xyz, model.rgb)
    assert in_scene(loose, here, model) is not None
    assert in_scene(LoosePoints(model.xyz + np.array([0, 0, 50]), model.rgb), here, model) is None
    assert in_scene(LoosePoints(1e-3 * model.xyz, model.rgb), here, model) is None, "in other units"


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_text_without_its_empty_lines(project: Path, end: str, mark: str) -> None:
    folder = as_text(project)
    lines = (folder / "images.txt").read_text().splitlines()
    posed = [line for line in lines if line.endswith("png")]
    (folder / "images.txt").write_text(mark + end.join(posed) + end, newline="")
    (folder / "points3D.txt").write_text("")
    assert sum(frame.pose is not None for frame in open_capture(project, IngestConfig()).frames) == 10


def test_a_model_next_to_its_images(project: Path) -> None:
    before = open_capture(project, IngestConfig())
    for file in (project / "sparse/0").iterdir():
        file.rename(project / file.name)
    shutil.rmtree(project / "sparse")
    capture = open_capture(project, IngestConfig())
    assert capture.kind == "colmap" and [f.pose is None for f in capture.frames] == [False] * 10
    assert capture.n_available == before.n_available
    assert set(externals(project, IngestConfig())["sparse"]) == {
        f"{n}.bin" for n in ("cameras", "images", "points3D")
    }


def test_rigs_and_frames_of_colmap_4(project: Path) -> None:
    folder = project / "sparse/0"
    pycolmap.Reconstruction(folder).write_binary(folder)
    assert (folder / "rigs.bin").is_file() and (folder / "frames.bin").is_file()
    assert sum(frame.pose is not None for frame in open_capture(project, IngestConfig()).frames) == 10


def test_a_model_without_cameras_names_the_file(project: Path) -> None:
    (project / "sparse/0/cameras.bin").unlink()
    with pytest.raises(InputError, match=r"has no cameras\.bin"):
        open_capture(project, IngestConfig())


# -- transforms.json ---------------------------------------------------------------------------------------


def test_listed_images_that_are_gone_are_left_out(posed: Path) -> None:
    for index in (2, 5, 6):
        (posed / f"images/{index:03d}.png").unlink()
    capture = open_capture(posed, IngestConfig())
    assert len(capture.frames) == 7
    assert any("3 of 10 images" in note and "images/002.png" in note for note in capture.notes)


def test_most_listed_images_gone_is_refused(posed: Path) -> None:
    for index in range(6):
        (posed / f"images/{index:03d}.png").unlink()
    with pytest.raises(InputError, match="lists 6 images that do not exist"):
        open_capture(posed, IngestConfig())


@pytest.mark.parametrize("change", [".png.png", ".PNG", ".jpg"])
def test_listed_images_of_other_endings(posed: Path, change: str) -> None:
    for path in list((posed / "images").iterdir()):
        path.rename(path.with_name(path.stem + change))
    capture = open_capture(posed, IngestConfig())
    assert [frame.path.name for frame in capture.frames] == [f"{i:03d}{change}" for i in range(10)]
    assert set(externals(posed, IngestConfig())["images"].values()) == {f.path for f in capture.frames}


def test_listed_images_in_another_folder(posed: Path) -> None:
    (posed / "images").rename(posed / "photos")
    capture = open_capture(posed, IngestConfig())
    assert {frame.path.parent.name for frame in capture.frames} == {"photos"}


@pytest.fixture
def split(posed: Path) -> Path:
    """Blender's form: a file for each part, no transforms.json."""
    data = json.loads((posed / "transforms.json").read_text())
    (posed / "transforms.json").unlink()
    parts = {"train": range(0, 7), "val": range(7, 8), "test": range(8, 10)}
    for part, numbers in parts.items():
        (posed / part).mkdir()
        entries = []
        for index in numbers:
            (posed / f"images/{index:03d}.png").rename(posed / f"{part}/r_{index}.png")
            entries.append({**data["frames"][index], "file_path": f"./{part}/r_{index}"})
        listing = {**data, "frames": entries}
        (posed / f"transforms_{part}.json").write_text(json.dumps(listing))
    (posed / "images").rmdir()
    return posed


def test_blenders_split_is_held_out(split: Path, ingest: Ingest) -> None:
    done = ingest(split, max_frames=24)
    parts = {frame.name: frame.split for frame in load_frames(done.out)}
    assert parts == {f"train/r_{i}.png": "train" for i in range(7)} | {
        f"test/r_{i}.png": "test" for i in range(8, 10)
    }
    assert done.result.summary["test"] == 2
    assert any("transforms_val.json" in text for text in done.warnings)
    assert not any("only" in text for text in done.warnings), "a run of at most 24 frames cannot have 30"
    named = externals(split, IngestConfig())
    assert {split / "transforms_train.json", split / "transforms_test.json"} <= {
        path for path in named.values() if isinstance(path, Path)
    }


def test_a_rule_replaces_the_split_of_the_input(split: Path, ingest: Ingest) -> None:
    done = ingest(split, holdout="r_0")
    assert [frame.name for frame in load_frames(done.out) if frame.split == "test"] == ["train/r_0.png"]


def test_without_test_views_those_of_val_are_held_out(split: Path) -> None:
    (split / "transforms_test.json").unlink()
    capture = open_capture(split, IngestConfig())
    assert [frame.name for frame in capture.frames if frame.test] == ["val/r_7.png"]


# -- videos ------------------------------------------------------------------------------------------------


def clip(path: Path, frames: int = 30, seed: int = 0) -> Path:
    """A pan over a texture, 10 frames per second."""
    picture = texture(seed)
    write_video(path, [picture[100:196, 4 * i : 4 * i + 128] for i in range(frames)], 10.0)
    return path


def test_a_folder_with_one_video(tmp_path: Path) -> None:
    clip(tmp_path / "walk.mp4")
    (tmp_path / ".DS_Store").write_bytes(b"x")
    capture = open_capture(tmp_path, IngestConfig())
    assert capture.kind == "video" and len(capture.frames) == 30
    assert externals(tmp_path, IngestConfig()) == {"capture": tmp_path / "walk.mp4"}


def test_a_folder_of_videos_is_one_capture(tmp_path: Path, ingest: Ingest) -> None:
    folder = tmp_path / "walks"
    folder.mkdir()
    clip(folder / "walk2.mp4", 20, seed=0), clip(folder / "walk10.MP4", 10, seed=0)
    capture = open_capture(folder, IngestConfig(max_frames=9))
    assert [frame.path.name for frame in capture.frames] == ["walk2.mp4"] * 6 + ["walk10.MP4"] * 3
    assert capture.frames[0].time_s == capture.frames[6].time_s == 0  # each has its own times
    chosen = select_sharp_frames(capture, 64, SilentReporter())
    assert len({frame.name for frame in chosen.frames}) == 9
    # A clip is a flat picture that moves, so it has no depth and no scene.
    with pytest.raises(StageError, match="no depth"):
        ingest(folder, max_frames=12, min_registered=0)
    twelve = open_capture(folder, IngestConfig(max_frames=12)).frames
    assert [frame.name.split("_")[0] for frame in twelve] == ["walk2"] * 8 + ["walk10"] * 4


def test_videos_of_one_stem_keep_names_of_their_own(tmp_path: Path) -> None:
    for place in ("one", "two"):  # in one folder, the smaller one would be a copy in another format
        (tmp_path / place).mkdir()
        clip(tmp_path / place / "a.mp4")
    names = [frame.name for frame in open_capture(tmp_path, IngestConfig()).frames]
    assert len(names) == len(set(names)) == 60


def test_photographs_go_before_videos(images: Path) -> None:
    clip(images / "live.MOV")
    capture = open_capture(images, IngestConfig())
    assert capture.kind == "images" and len(capture.frames) == 10
    assert any("live.MOV" in note and "left out" in note for note in capture.notes)


def test_a_stretch_of_a_video(tmp_path: Path) -> None:
    path = clip(tmp_path / "walk.mp4")
    capture = open_capture(path, IngestConfig(start=0.95, end=2.05, max_frames=4))
    times = [frame.time_s for frame in capture.frames]
    assert np.allclose(times, [1.0, 1.3, 1.7, 2.0], atol=0.051)
    assert capture.frames[0].name == "walk_000010"  # the numbers are those of the whole video
    chosen = select_sharp_frames(capture, 64, SilentReporter())
    assert all(0.95 <= (frame.time_s or 0) <= 2.05 for frame in chosen.frames)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"start": 2.0, "end": 1.0}, "ingest.start"),
        ({"start": 9.0}, "lasts 2.9 s"),
        ({"end": 0.1}, "2 frames"),
    ],
)
def test_a_stretch_without_frames(tmp_path: Path, settings: dict[str, Any], words: str) -> None:
    path = clip(tmp_path / "walk.mp4")
    with pytest.raises(InputError, match=words):
        open_capture(path, IngestConfig(**settings))


def test_photographs_have_no_stretch(images: Path) -> None:
    with pytest.raises(InputError, match="not a video"):
        open_capture(images, IngestConfig(start=1))


def test_files_that_are_not_read_are_named(images: Path) -> None:
    (images / "IMG_1.DNG").write_bytes(b"II*\0")
    capture = open_capture(images, IngestConfig())
    assert any("IMG_1.DNG" in note for note in capture.notes)


# -- pictures ----------------------------------------------------------------------------------------------


def panorama(shift: int) -> np.ndarray:
    """An equirectangular picture: its left and right edges are neighbours."""
    picture = np.concatenate([texture(0), texture(0)[:, ::-1]], axis=1)
    return np.roll(picture[:512], shift, axis=1)


@pytest.mark.parametrize("noted", [True, False])
def test_panoramas_are_refused_by_name(tmp_path: Path, ingest: Ingest, noted: bool) -> None:
    folder = tmp_path / "round"
    folder.mkdir()
    xmp = (
        b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        b'<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
        b'GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
    )
    for index in range(4):
        picture = panorama(20 * index) if not noted else np.hstack([texture(index), texture(index + 9)])
        Image.fromarray(picture).save(folder / f"{index}.jpg", quality=95, xmp=xmp if noted else b"")
    with pytest.raises(InputError, match="equirectangular"):
        ingest(folder)


def test_text_burnt_into_the_pictures_is_masked(posed: Path, ingest: Ingest) -> None:
    plain = ingest(posed, "plain")
    for path in (posed / "images").iterdir():
        picture = cv2.imread(str(path))
        cv2.putText(picture, "12:45 CAM 7", (8, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2)
        cv2.putText(picture, "REC 0042", (190, 228), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (0, 255, 255), 2)
        cv2.imwrite(str(path), picture)
    done = ingest(posed, "burnt")
    said = [any("never move" in text for text in run.warnings) for run in (plain, done)]
    assert said == [False, True]
    frame = load_frames(done.out)[0]
    assert frame.mask is not None and load_frames(plain.out)[0].mask is None
    mask = cv2.imread(str(done.out / frame.mask), cv2.IMREAD_GRAYSCALE)
    bare, burnt = (cv2.imread(str(run.out / frame.image)).astype(int) for run in (plain, done))
    changed = np.abs(bare - burnt).max(axis=2) > 40
    assert (mask[changed] == 0).mean() > 0.95 and (mask == 0).mean() < 0.2


def test_a_patterned_bar_does_not_keep_frames_out(images: Path, ingest: Ingest) -> None:
    bar = texture(7)[:60, :320]
    for path in images.iterdir():
        picture = cv2.imread(str(path))
        picture[180:] = bar
        cv2.imwrite(str(path), picture)
    done = ingest(images)
    assert done.result.summary["registered"] == 10
    assert any("never move" in text for text in done.warnings)


def test_poses_bounds_are_read_where_the_model_names_other_images(project: Path, ingest: Ingest) -> None:
    """As Deblur-NeRF's folders have them: the COLMAP model names files that its authors did not publish."""
    for index, path in enumerate(sorted((project / "images").iterdir())):
        path.rename(path.with_name(f"IMG_{index:04d}.png"))
    with pytest.raises(InputError, match="lists 10 images that do not exist"):
        open_capture(project, IngestConfig())
    np.save(project / "poses_bounds.npy", poses_bounds(camera_to_world(10)))
    done = ingest(project)
    assert done.result.summary["kind"] == "llff" and done.result.summary["registered"] == 10
    assert any("10 of 10 images" in text and "poses_bounds.npy is read" in text for text in done.warnings)
    assert any("only 10 frames" in text for text in done.warnings)
    assert externals(project, IngestConfig())["poses_bounds"] == project / "poses_bounds.npy"
