"""Folders as people drop them on the program: what is read, with which poses, and what is left out."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from cleargs.capture.choice import select_sharp_frames
from cleargs.capture.prepare import read_source_mask
from cleargs.capture.sources import externals, open_capture, whole_capture
from cleargs.cli.main import invoke
from cleargs.errors import InputError
from cleargs.media import headers
from cleargs.progress import SilentReporter
from cleargs.stages.ingest import IngestConfig

from . import apps
from .conftest import FOCAL, HEIGHT, WIDTH, Ingest, Ingested
from .test_data_sets import poses_bounds

Frames = Sequence[tuple[NDArray[np.float64], NDArray[np.uint8]]]


def write(app: apps.Writer, root: Path, frames: Frames) -> Path:
    app(root, [image for _, image in frames], [pose for pose, _ in frames])
    return root


READ: dict[str, tuple[apps.Writer, int, str]] = {
    "TUM": (apps.tum, 10, "left out: 10 depth maps (depth/)"),
    "RTAB-Map": (apps.rtabmap, 10, "left out: 10 depth maps (room_depth/)"),
    "NeRFCapture": (apps.nerfcapture, 10, "left out: 10 depth maps (images/)"),
    "Stray Scanner": (apps.stray, 10, "10 poses of Stray Scanner"),
    "Polycam": (apps.polycam, 10, "1 preview (thumbnail.jpg)"),
    "Record3D": (apps.record3d, 10, "10 poses of Record3D"),
    "3D Scanner App": (apps.scanner_app, 10, "10 previews"),
    "ScanNet": (apps.scannet, 10, "10 depth maps (depth/)"),
    "7-Scenes": (apps.seven_scenes, 10, "10 depth maps"),
    "DCIM": (apps.iphone, 10, "10 photographs (DCIM/100APPLE/ 4, DCIM/101APPLE/ 6)"),
    "rig": (apps.two_cameras, 10, "10 photographs (images/cam0/ 5, images/cam1/ 5)"),
    "copies": (apps.reduced_copies, 10, "in another format (tiff/ 10, web/ 10, thumbs/ 10)"),
    "masks": (apps.masks_beside, 10, "10 masks"),
    "Metashape": (apps.metashape, 10, "10 photographs (photos/) and 10 masks (mask/)"),
    "ScanNet++": (apps.scannetpp, 10, "and 10 masks (iphone/rgb_masks/); left out: 10 depth maps"),
    "maps": (apps.monocular_maps, 10, "10 photographs (rgb/); left out: 20 second pictures"),
    "edited": (apps.edited_and_downloaded_twice, 10, "left out: 3 second pictures"),
    "RealSense": (apps.realsense, 10, "20 infrared pictures (infrared/ 10, infrared2/ 10), 10 depth maps"),
    "RealSense Viewer": (apps.realsense_viewer, 10, "left out: 10 infrared pictures, 10 depth maps"),
    "Azure Kinect": (apps.azure_kinect, 10, "left out: 10 infrared pictures (ir/), 10 depth maps (depth/)"),
    "maps by name": (apps.maps_by_name, 10, "left out: 20 second pictures"),
    "Hypersim": (
        apps.hypersim,
        10,
        "20 second pictures, reduced or in another format (images/scene_cam_00_geom",
    ),
    "DTU": (apps.dtu, 10, "10 photographs (image/) and 10 masks (mask/)"),
    "thermal": (apps.dji_thermal, 10, "left out: 10 infrared pictures"),
    "products": (
        apps.photogrammetry,
        10,
        "10 photographs (photos/); left out: 2 pictures named as a texture",
    ),
    "exported": (apps.exported, 10, "left out: 10 second pictures"),
    "upscaled": (apps.upscaled, 10, "10 photographs (room/); left out: 20 second pictures"),
    "BlendedMVS": (apps.blended_mvs, 10, "left out: 10 second pictures"),
    "Sony": (apps.sony, 40, "4 videos (PRIVATE/M4ROOT/CLIP/); left out: 4 previews (PRIVATE/M4ROOT/THMBNL/)"),
    "Insta360": (apps.insta360, 10, "1 video (VID_20240101_120000_00_001.mp4); left out: 1 preview (LRV"),
    "edited video": (apps.edited_video, 10, "1 video in folders below (old/film.mp4), 1 preview (Proxies/"),
    "live": (apps.live_photographs, 10, "10 photographs; left out: 10 videos"),
    "NeRFCapture offline": (
        apps.nerfcapture_offline,
        10,
        "10 pictures that transforms.json lists; left out: 10",
    ),
    "contact sheet": (apps.contact_sheet, 10, "10 photographs; left out: 1 preview (Contact Sheet.jpg)"),
    "GoPro": (apps.gopro, 20, "2 videos (DCIM/100GOPRO/GX010123.MP4, DCIM/100GOPRO/GX020123.MP4)"),
    "DJI": (apps.dji, 10, "1 video (DCIM/DJI_001/DJI_20240101120000_0001_D.MP4)"),
    "DJI panorama": (
        apps.dji_panorama,
        10,
        "left out: 10 pictures of panoramas from one spot (DCIM/PANORAMA",
    ),
    "multispectral": (apps.dji_multispectral, 10, "10 infrared pictures, 30 TIFF pictures of one channel"),
    "MicaSense": (apps.micasense, 10, "left out: 40 pictures of other spectral bands (0000SET/000/)"),
    "many bands": (apps.many_bands, 10, "left out: 10 pictures with other channels than red, green and blue"),
    "Matterport": (apps.matterport, 10, "6 pictures of panoramas from one spot (matterport_skybox_images/)"),
    "raw": (apps.raw_and_jpeg, 10, "10 photographs; left out: 21 second pictures"),
    "Pixel": (apps.pixel_portraits, 10, "left out: 10 second pictures"),
    "EuRoC": (apps.euroc, 20, "20 photographs (mav0/cam0/data/ 10, mav0/cam1/data/ 10)"),
    "KITTI": (apps.kitti, 20, "left out: 20 pictures of one channel (image_0/ 10, image_1/ 10)"),
    "Replica": (apps.replica, 10, "10 photographs (results/); left out: 10 depth maps (results/)"),
    "HyperNeRF": (apps.hypernerf, 10, "10 photographs (rgb/1x/); left out: 30 second pictures"),
    "ARKitScenes": (apps.arkit_scenes, 20, "20 photographs (ultrawide/ 10, vga_wide/ 10)"),
    "OpenSfM": (apps.opensfm, 10, "10 photographs (images/); left out: 21 pictures outside images/"),
    "KIRI": (apps.kiri, 10, "10 photographs (photos/); left out: 1 picture named as a texture"),
    "previews": (apps.previews_at_the_top, 10, "2 previews (cover_0.jpg, cover_1.jpg)"),
}


@pytest.mark.parametrize("app", READ)
def test_photographs_are_read_and_the_rest_is_told(tmp_path: Path, frames: Frames, app: str) -> None:
    writer, count, told = READ[app]
    root = write(writer, tmp_path / "capture", frames)
    for poses in ("auto", "sfm"):
        capture = open_capture(root, IngestConfig(poses=poses))
        assert len(capture.frames) == capture.n_available == count
        assert poses == "sfm" or told in capture.told
        depths = ("depth", "conf", "thumb", "mask", "cover", "web", "infra", "ir/", "pano", "sky")
        assert not any(word in frame.name for frame in capture.frames for word in depths)
        named = externals(root, IngestConfig(poses=poses)).values()
        files = {p for place in named for p in (place.values() if isinstance(place, dict) else [place])}
        assert all({f.path, *f.path.parents} & files for f in capture.frames)


@pytest.mark.parametrize(
    "app", ["TUM", "Stray Scanner", "Polycam", "Record3D", "3D Scanner App", "ScanNet", "7-Scenes"]
)
def test_poses_of_apps_are_those_planted(tmp_path: Path, frames: Frames, app: str) -> None:
    capture = open_capture(write(READ[app][0], tmp_path / "capture", frames), IngestConfig())
    assert capture.kind == "rgbd" and capture == select_sharp_frames(capture, 64, SilentReporter())
    for frame, (pose, _) in zip(capture.frames, frames, strict=True):
        if app == "ScanNet" and frame is capture.frames[-1]:
            assert frame.pose is None
            continue
        assert frame.pose is not None
        world_to_camera = np.linalg.inv(pose)
        assert np.allclose(frame.pose.rotation, world_to_camera[:3, :3], atol=1e-6)
        assert np.allclose(frame.pose.translation, world_to_camera[:3, 3], atol=1e-6)
        if app not in ("TUM", "7-Scenes"):
            assert frame.camera is not None and np.allclose(frame.camera.focal, FOCAL)


@pytest.mark.parametrize(
    ("app", "folder"), [(apps.eth3d, "dslr_calibration_undistorted"), (apps.scannetpp_dslr, "colmap")]
)
def test_models_in_folders_of_data_sets(
    tmp_path: Path, frames: Frames, app: apps.Writer, folder: str
) -> None:
    root = write(app, tmp_path / "capture", frames)
    capture = open_capture(root, IngestConfig())
    assert capture.kind == "colmap" and [frame.pose is None for frame in capture.frames] == [False] * 10
    assert f"10 with a pose in the COLMAP model of {folder}/" in capture.told
    assert whole_capture(root / folder / "images.txt") == root


@pytest.mark.parametrize("app", ["Stray Scanner", "Polycam", "7-Scenes"])
def test_apps_are_ingested_with_their_poses(tmp_path: Path, frames: Frames, ingest: Ingest, app: str) -> None:
    done = ingest(write(READ[app][0], tmp_path / "capture", frames))
    assert done.result.summary["registered"] == 10 and READ[app][2] in done.result.summary["input"]
    assert done.result.summary["poses"] in ("given", "adjusted")
    assert done.result.summary["cameras"][0]["focal_px"] == pytest.approx(FOCAL, rel=0.03)


def test_rtabmap_is_placed_by_its_pictures(tmp_path: Path, frames: Frames, ingest: Ingest) -> None:
    done = ingest(write(apps.rtabmap, tmp_path / "capture", frames))
    assert done.result.summary["registered"] == 10 and done.result.summary["poses"] == "sfm"


@pytest.mark.parametrize(
    ("app", "file", "text"),
    [
        ("TUM", "groundtruth.txt", "1305031102.17 1 2"),
        ("Stray Scanner", "odometry.csv", "a\n1, 2, x"),
        ("Stray Scanner", "camera_matrix.csv", "1 2"),
        ("Record3D", "metadata.json", "{}"),
        ("ScanNet", "pose/3.txt", "1 0 0"),
        ("3D Scanner App", "frame_00003.json", "[]"),
    ],
)
def test_damaged_poses_of_apps(tmp_path: Path, frames: Frames, app: str, file: str, text: str) -> None:
    root = write(READ[app][0], tmp_path / "capture", frames)
    (root / file).write_text(text)
    capture = open_capture(root, IngestConfig())
    assert len(capture.frames) == 10 and not capture.posed
    assert any(f"cannot read the poses of {app}" in note or "the pose of" in note for note in capture.notes)
    assert not open_capture(root, IngestConfig(poses="sfm")).notes


@pytest.mark.parametrize(
    "app", [apps.masks_beside, apps.masks_of_the_same_stem, apps.white_masks_of_the_same_stem]
)
def test_masks_beside_their_photographs_are_used(tmp_path: Path, frames: Frames, app: apps.Writer) -> None:
    root = write(app, tmp_path / "capture", frames)
    for frame in open_capture(root, IngestConfig()).frames:
        source_mask = read_source_mask(frame)
        assert source_mask is not None and not source_mask[:60].any() and source_mask[60:].all()
    assert len(externals(root, IngestConfig())["masks_beside"]) == 10


@pytest.mark.parametrize(
    ("settings", "left"),
    [
        ({"only": "cam0"}, 5),
        ({"skip": "images/cam0"}, 5),
        ({"only": "images/cam1/*"}, 5),
        ({"only": "0001.png, cam0/0002.png, 0000.*"}, 4),
        ({"only": "cam0", "skip": "0000.png"}, 4),
    ],
)
def test_files_by_choice(tmp_path: Path, frames: Frames, settings: dict[str, str], left: int) -> None:
    root = write(apps.two_cameras, tmp_path / "capture", frames)
    capture = open_capture(root, IngestConfig.model_validate(settings))
    assert len(capture.frames) == left and f"{10 - left} files by --only or --skip" in capture.told


def test_listed_files_by_choice(posed: Path) -> None:
    capture = open_capture(posed, IngestConfig(skip="00[0-3].png"))
    assert [frame.name for frame in capture.frames] == [f"images/{index:03d}.png" for index in range(4, 10)]


def test_a_choice_of_nothing(images: Path) -> None:
    with pytest.raises(InputError, match="leave out all 10"):
        open_capture(images, IngestConfig(only="cam7"))


def test_no_name_is_there_twice(tmp_path: Path, frames: Frames) -> None:
    for app in READ:
        root = write(READ[app][0], tmp_path / app, frames)
        names = [frame.name for frame in open_capture(root, IngestConfig()).frames]
        assert len(names) == len(set(names))


def test_grey_photographs_are_photographs(images: Path) -> None:
    for path in images.iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    assert len(open_capture(images, IngestConfig()).frames) == 10


def test_photographs_of_a_thermal_camera_have_16_bits(images: Path) -> None:
    for path in images.iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint16) * 257)
    assert len(open_capture(images, IngestConfig()).frames) == 10


def test_photographs_of_an_infrared_camera_alone_are_taken(images: Path) -> None:
    images.rename(images.with_name("infrared"))
    capture = open_capture(images.parent, IngestConfig())
    assert (len(capture.frames), capture.told) == (10, "read: 10 photographs (infrared/)")


def test_two_lenses_of_a_phone_stay(images: Path) -> None:
    """Half the size, but as many, and other pictures."""
    for index, path in enumerate(sorted(images.iterdir())):
        if index % 2:
            cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), None, fx=0.5, fy=0.5))
    assert len(open_capture(images, IngestConfig()).frames) == 10


def test_a_run_in_the_folder_is_no_photograph(images: Path, frames: Frames) -> None:
    for index, (_, image) in enumerate(reversed(frames)):
        apps.save(images / f"room/ingest/images/view{index}.png", image)
    assert len(open_capture(images, IngestConfig()).frames) == 20
    (images / "room" / "run.toml").touch()
    assert len(open_capture(images, IngestConfig()).frames) == 10


def result(folder: Path, kind: str, pictures: apps.Pictures) -> None:
    """Write a run, a store or an exported capture with ``pictures`` into ``folder``."""
    for index, picture in enumerate(pictures):
        apps.save(folder / f"ingest/images/{index}.png", picture)
    marks = {"run": "run.toml", "store": "locks/store.lock", "export": "ingest/sparse/0/images.bin"}
    (folder / marks[kind]).parent.mkdir(parents=True, exist_ok=True)
    (folder / marks[kind]).touch()


@pytest.mark.parametrize("app", ["DCIM", "masks", "TUM", "Insta360", "Sony", "edited video", "RealSense"])
@pytest.mark.parametrize("kind", ["run", "store", "export"])
def test_results_in_a_capture_change_nothing(tmp_path: Path, frames: Frames, app: str, kind: str) -> None:
    root, config = write(READ[app][0], tmp_path / "capture", frames), IngestConfig()
    told, digested = open_capture(root, config).told, externals(root, config)
    result(root / "out", kind, [255 - image for _, image in frames])
    again = open_capture(root, config)
    assert not any("out/" in str(frame.path) for frame in again.frames)
    assert externals(root, config) == digested and (kind == "export" or again.told == told)


@pytest.mark.parametrize("kind", ["run", "store"])
def test_results_next_to_a_model_change_nothing(posed: Path, frames: Frames, kind: str) -> None:
    (posed / "sparse").mkdir()
    (posed / "transforms.json").unlink()
    (posed / "sparse/images.bin").write_bytes(bytes(8))
    before = externals(posed, IngestConfig())
    result(posed / "out", kind, [image for _, image in frames])
    assert externals(posed, IngestConfig()) == before


@pytest.mark.parametrize(
    ("app", "place", "refused"),
    [
        ("previews", "out", False),
        ("previews", "shots/out", True),
        ("masks", "out", True),
        ("TUM", "out", False),
        ("TUM", "rgb/out", True),
        ("DCIM", "out", False),
        ("DCIM", "DCIM/100APPLE/out", True),
        ("Insta360", "VID", False),
        ("Sony", "out", False),
    ],
)
def test_a_run_may_be_next_to_photographs_but_not_among_them(
    tmp_path: Path, frames: Frames, capsys: pytest.CaptureFixture[str], app: str, place: str, refused: bool
) -> None:
    root = write(READ[app][0], tmp_path / "capture", frames)
    code = invoke(["run", str(root), "-o", str(root / place), "--dry-run", "--until", "ingest"])
    said = capsys.readouterr().err
    assert (code, "inside the input" in said) == ((2, True) if refused else (0, False)), said
    assert not (root / place).exists()


@pytest.mark.parametrize(
    "links",
    [{"a": "."}, {"a": ".", "b": "."}, {"in/a": "..", "in/b": ".."}, {"masks/a": ".", "masks/b": ".."}],
)
def test_each_folder_is_entered_once(images: Path, links: dict[str, str]) -> None:
    for name, target in links.items():
        (images / name).parent.mkdir(exist_ok=True)
        (images / name).symlink_to(target)
    capture = open_capture(images, IngestConfig())
    assert (capture.n_available, capture.told) == (10, "read: 10 photographs")
    externals(images, IngestConfig())


@pytest.mark.parametrize("name", [".thumbnails", "@eaDir", "__MACOSX", "#recycle"])
def test_folders_of_systems_are_not_read(images: Path, name: str) -> None:
    shutil.copytree(images, images.parent / "copy")
    shutil.move(images.parent / "copy", images / name)
    capture = open_capture(images, IngestConfig())
    assert len(capture.frames) == 10 and capture.told == "read: 10 photographs"


def test_formats_that_need_a_package_are_left_out_with_a_warning(
    images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(headers, "find_spec", lambda name: None)
    for index in range(3):
        (images / f"IMG_{index}.HIF").write_bytes(b"\0\0\0\x18ftypheic" + bytes(12))
    capture = open_capture(images, IngestConfig())
    assert len(capture.frames) == 10
    assert any("3 HEIC pictures" in note and "cleargs[heif]" in note for note in capture.notes)


def test_live_photographs_in_two_formats_are_taken_once(images: Path) -> None:
    for path in list(images.iterdir()):
        Image.open(path).save(path.with_suffix(".jpg"))
    capture = open_capture(images, IngestConfig())
    assert len(capture.frames) == 10 and "10 second pictures" in capture.told


PARTS = [
    "transforms.json",
    "images/003.png",
    "sparse",
    "sparse/0",
    "sparse/0/cameras.bin",
    "sparse/0/points3D.bin",
    "database.db",
    "colmap/sparse/0/images.txt",
    "poses_bounds.npy",
]


@pytest.mark.parametrize("part", PARTS)
def test_a_file_of_a_capture_stands_for_it(posed: Path, part: str) -> None:
    if not (posed / part).exists():
        file = posed / (part if Path(part).suffix else f"{part.removesuffix('/0')}/0/cameras.bin")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    assert whole_capture(posed / part) == posed


def test_other_files_and_folders_stand_for_themselves(tmp_path: Path, images: Path) -> None:
    clip = tmp_path / "walk.mp4"
    clip.touch()
    (tmp_path / "2024").mkdir()
    shutil.copy(images / "view1.png", tmp_path / "2024" / "a.png")
    assert whole_capture(clip) == clip and whole_capture(images) == images
    assert whole_capture(images / "view3.png") == images
    assert whole_capture(tmp_path / "2024/a.png") == tmp_path / "2024"
    assert whole_capture(tmp_path / "nothing") == tmp_path / "nothing"


def test_a_capture_whose_name_is_a_number(tmp_path: Path, images: Path) -> None:
    """COLMAP's automatic reconstructor writes the undistorted images and their model into dense/0."""
    whole = tmp_path / "dense" / "0"
    shutil.copytree(images, whole / "images")
    (whole / "sparse").mkdir()
    (whole / "sparse/cameras.bin").touch()
    assert whole_capture(whole / "sparse") == whole_capture(whole / "sparse/cameras.bin") == whole
    shutil.copytree(images, tmp_path / "images")
    assert any(f"give {whole} as" in note for note in open_capture(tmp_path, IngestConfig()).notes)


def test_videos_next_to_few_photographs_are_the_capture(tmp_path: Path, frames: Frames) -> None:
    apps.clip(tmp_path / "walk.mp4", [image for _, image in frames])
    cv2.imwrite(str(tmp_path / "poster.jpg"), frames[0][1])
    capture = open_capture(tmp_path, IngestConfig())
    assert capture.kind == "video" and "1 preview (poster.jpg)" in capture.told
    (tmp_path / "100GOPRO").mkdir()
    (tmp_path / "walk.mp4").rename(tmp_path / "100GOPRO/GX01.MP4")
    assert open_capture(tmp_path, IngestConfig()).kind == "video"


@pytest.mark.parametrize(
    "place", ["mask/{}.png", "shots/masks/{}.jpg.png", "shots/mask_{}.png", "shots/{}.mask.png"]
)
def test_masks_at_other_places(tmp_path: Path, frames: Frames, place: str) -> None:
    for index, (_, image) in enumerate(frames):
        apps.save(tmp_path / f"shots/{index:03d}.jpg", image)
        apps.save(
            tmp_path / place.format(f"{index:03d}"), np.full((240, 320, 3), 255 * (index > 0), np.uint8)
        )
    capture = open_capture(tmp_path, IngestConfig())
    masks = [read_source_mask(frame) for frame in capture.frames]
    assert len(masks) == 10 and "and 10 masks" in capture.told
    assert [None if s is None else bool(s.all()) for s in masks] == [False] + [True] * 9


def test_masks_with_numbers_that_start_elsewhere_are_not_guessed(tmp_path: Path, frames: Frames) -> None:
    root = write(apps.dtu, tmp_path / "capture", frames)
    (root / "mask/000.png").rename(root / "mask/010.png")
    capture = open_capture(root, IngestConfig())
    assert "10 masks without a photograph of the same name" in capture.told


def test_masks_that_fit_no_photograph_are_named(tmp_path: Path, frames: Frames) -> None:
    root = write(apps.iphone, tmp_path / "capture", frames)
    for index in range(3):
        apps.save(root / f"masks/person{index}/all.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    capture = open_capture(root, IngestConfig())
    assert "left out: 3 masks without a photograph of the same name" in capture.told
    assert any("name masks like their photographs" in note for note in capture.notes)


@pytest.mark.parametrize("only", [None, "images/00000[0-4].png"])
def test_listed_pictures_are_told(made: Ingested, frames: Frames, tmp_path: Path, only: str | None) -> None:
    root, config = tmp_path / "project", IngestConfig(only=only)
    shutil.copytree(made.out / "images", root / "images")
    shutil.copytree(made.out / "colmap/sparse", root / "sparse")
    apps.save(root / "images_2/000000.png", np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8))
    count = 10 if only is None else 5
    read = f"read: {count} pictures, {count} with a pose in"
    told = open_capture(root, config).told
    assert told.startswith(f"{read} the COLMAP model of sparse/0/; left") and "images_2/ 1" in told
    shutil.rmtree(root / "sparse")
    np.save(root / "poses_bounds.npy", poses_bounds([pose for pose, _ in frames]))
    assert open_capture(root, config).told.startswith(f"{read} poses_bounds.npy; left")


def test_the_sharp_portraits_and_the_first_band_are_taken(tmp_path: Path, frames: Frames) -> None:
    portraits = open_capture(write(apps.pixel_portraits, tmp_path / "phone", frames), IngestConfig())
    assert not any("COVER" in frame.name for frame in portraits.frames)
    bands = open_capture(write(apps.micasense, tmp_path / "drone", frames), IngestConfig())
    assert all(frame.name.endswith("_1.tif") for frame in bands.frames)
    assert any("--only takes another" in note for note in bands.notes)
    third = open_capture(tmp_path / "drone", IngestConfig(only="*_3.tif"))
    assert len(third.frames) == 10 and all(frame.name.endswith("_3.tif") for frame in third.frames)


def test_a_preview_next_to_a_scan_names_the_scan(tmp_path: Path, frames: Frames) -> None:
    cv2.imwrite(str(tmp_path / "preview.jpg"), frames[0][1])
    (tmp_path / "scan.ply").write_text("ply")
    with pytest.raises(InputError, match="gives 1 frame; a scene needs") as refused:
        open_capture(tmp_path, IngestConfig())
    assert "scan.ply is a 3D scene or model" in str(refused.value.hint)


def test_a_dry_run_gives_the_warnings(images: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (images / "a.DNG").write_bytes(b"II*\0")
    assert invoke(["run", str(images), "-o", str(images.parent / "run"), "--dry-run"]) == 0
    told = capsys.readouterr().err
    assert "warning: left out: 1 raw or other picture (a.DNG); convert them to JPEG or PNG" in told


def test_panoramas_alone_are_taken(tmp_path: Path, frames: Frames) -> None:
    root = write(apps.dji_panorama, tmp_path / "drone", frames)
    shutil.rmtree(root / "DCIM/100MEDIA")
    assert len(open_capture(root, IngestConfig()).frames) == 10
    root = write(apps.matterport, tmp_path / "matterport", frames)
    assert len(open_capture(root, IngestConfig(only="*skybox*")).frames) == 6


@pytest.mark.parametrize("bands", [True, False])
def test_pictures_of_other_channels_alone_are_refused_by_name(tmp_path: Path, bands: bool) -> None:
    """Spectral bands, and Lab: Pillow would take its numbers for colours."""
    for index in range(4):
        if bands:
            apps.write_many_bands(tmp_path / f"{index}.tif")
        else:
            Image.new("LAB", (32, 24)).save(tmp_path / f"{index}.tif")
    with pytest.raises(InputError, match="other channels than red, green and blue") as refused:
        open_capture(tmp_path, IngestConfig())
    assert "as JPEG or PNG" in str(refused.value.hint)


def test_raw_photographs_are_told(images: Path) -> None:
    for name in ("a.DNG", "b.CR3", "c.hdr"):
        (images / name).write_bytes(b"II*\0")
    assert "3 raw or other pictures (a.DNG, b.CR3, c.hdr)" in open_capture(images, IngestConfig()).told


def test_exr_pictures_are_told(images: Path) -> None:
    (images / "depth").mkdir()
    for index in range(3):
        (images / f"depth/{index}.exr").touch()
    capture = open_capture(images, IngestConfig())
    assert "left out: 3 EXR pictures, depth or rendered layers (depth/0.exr, " in capture.told


def test_poses_in_a_folder_below_are_not_passed_over_in_silence(posed: Path) -> None:
    outer = posed.parent / "outer"
    outer.mkdir()
    posed.rename(outer / "room")
    capture = open_capture(outer, IngestConfig())
    assert len(capture.frames) == 10 and capture.kind == "images"
    assert any(f"give {outer / 'room'} as the input" in note for note in capture.notes)
    assert open_capture(outer, IngestConfig(poses="sfm")).notes == ()


def test_a_backup_of_the_photographs_is_not_read_twice(images: Path, frames: Frames) -> None:
    shutil.copytree(images, images.parent / "copy")
    shutil.move(images.parent / "copy", images / "backup")
    assert len(open_capture(images, IngestConfig()).frames) == 10
    cv2.imwrite(str(images / "backup/view3.png"), frames[4][1])  # now they are pictures of a second camera
    assert len(open_capture(images, IngestConfig()).frames) == 20


def test_videos_by_choice(tmp_path: Path, frames: Frames) -> None:
    for name in ("walk1.mp4", "walk2.mp4"):
        apps.clip(tmp_path / name, [image for _, image in frames])
    capture = open_capture(tmp_path, IngestConfig(only="walk2*"))
    assert {frame.path.name for frame in capture.frames} == {"walk2.mp4"}
    assert externals(tmp_path, IngestConfig(only="walk2*")) == {"capture": tmp_path / "walk2.mp4"}
