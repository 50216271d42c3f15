"""Folders as apps and cameras write them, from their public descriptions: one function per app.

Each takes a folder, the pictures (BGR) and their poses (camera to world, OpenCV axes), and writes the files
of the app. Depth and confidence maps are noise: their headers are what counts.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TypeAlias

import av
import cv2
import numpy as np
import OpenImageIO
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .conftest import FOCAL, HEIGHT, WIDTH

Poses: TypeAlias = Sequence[NDArray[np.float64]]
Pictures: TypeAlias = Sequence[NDArray[np.uint8]]
Writer: TypeAlias = Callable[[Path, Pictures, Poses], None]

K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's axes of a camera to those of OpenGL and ARKit, and back."""


def save(path: Path, picture: NDArray[np.generic]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture)


def depth(path: Path, seed: int = 0) -> None:
    """A depth map in millimetres, as small as a phone's: 16 bits, one channel."""
    save(path, np.random.default_rng(seed).integers(500, 4000, (48, 64)).astype(np.uint16))


def confidence(path: Path) -> None:
    save(path, np.random.default_rng(0).integers(0, 3, (48, 64)).astype(np.uint8))


def words(*numbers: object) -> str:
    return " ".join(str(number) for number in numbers)


def translation_and_quaternion(pose: NDArray[np.float64]) -> list[float]:
    """x, y, z, qx, qy, qz, qw."""
    return [*pose[:3, 3].tolist(), *Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()]


def tum(root: Path, pictures: Pictures, poses: Poses) -> None:
    """TUM RGB-D: lists of pictures by time, and a motion capture at its own times."""
    names, track = ["# color images"], ["# timestamp tx ty tz qx qy qz qw"]
    for index, (picture, pose) in enumerate(zip(pictures, poses, strict=True)):
        time = 1305031102.175304 + index / 30
        save(root / f"rgb/{time:.6f}.png", picture)
        depth(root / f"depth/{time + 0.005:.6f}.png", index)
        names.append(f"{time:.6f} rgb/{time:.6f}.png")
        track.append(words(f"{time - 0.004:.4f}", *translation_and_quaternion(pose)))
    (root / "rgb.txt").write_text("\n".join(names))
    (root / "groundtruth.txt").write_text("\n".join(track))


def rtabmap(root: Path, pictures: Pictures, poses: Poses) -> None:
    """RTAB-Map's export of pictures; its poses may be those of a robot, and are not read."""
    for index, picture in enumerate(pictures):
        save(root / f"room_rgb/{index + 1}.jpg", picture)
        depth(root / f"room_depth/{index + 1}.png")


def nerfcapture(root: Path, pictures: Pictures, poses: Poses) -> None:
    """NeRFCapture, without its transforms.json."""
    for index, picture in enumerate(pictures):
        save(root / f"images/{index}.png", picture)
        depth(root / f"images/{index}.depth.png")


def clip(path: Path, pictures: Pictures) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(path, "w") as video:
        stream = video.add_stream("libx264", rate=10, options={"crf": "10", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for index, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
            frame.pts, frame.time_base = index, Fraction(1, 10)
            video.mux(stream.encode(frame))
        video.mux(stream.encode(None))


def stray(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Stray Scanner."""
    clip(root / "rgb.mp4", pictures)
    (root / "camera_matrix.csv").write_text("\n".join(", ".join(map(str, row)) for row in K.tolist()))
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for index, pose in enumerate(poses):
        depth(root / f"depth/{index:06d}.png", index)
        confidence(root / f"confidence/{index:06d}.png")
        lines.append(", ".join(map(str, [index / 10, f"{index:06d}", *translation_and_quaternion(pose)])))
    (root / "odometry.csv").write_text("\n".join(lines))


def polycam(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Polycam's raw data."""
    save(root / "thumbnail.jpg", cv2.resize(pictures[0], (WIDTH, HEIGHT)))
    for index, (picture, pose) in enumerate(zip(pictures, poses, strict=True)):
        name = str(98765432100 + 333 * index)
        save(root / f"keyframes/images/{name}.jpg", picture)
        save(root / f"keyframes/corrected_images/{name}.jpg", picture)
        depth(root / f"keyframes/depth/{name}.png")
        confidence(root / f"keyframes/confidence/{name}.png")
        matrix = pose @ OPENGL
        data = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
        data |= {
            "fx": FOCAL,
            "fy": FOCAL,
            "cx": WIDTH / 2,
            "cy": HEIGHT / 2,
            "width": WIDTH,
            "height": HEIGHT,
        }
        for folder in ("cameras", "corrected_cameras"):
            (root / "keyframes" / folder).mkdir(exist_ok=True)
            (root / "keyframes" / folder / f"{name}.json").write_text(json.dumps(data))


def record3d(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Record3D's export of pictures and depth (EXR)."""
    quaternions = []
    for index, (picture, pose) in enumerate(zip(pictures, poses, strict=True)):
        save(root / f"rgb/{index}.jpg", picture)
        (root / "depth").mkdir(exist_ok=True)
        (root / f"depth/{index}.exr").write_bytes(b"\x76\x2f\x31\x01")
        x = translation_and_quaternion(pose @ OPENGL)
        quaternions.append([*x[3:], *x[:3]])
    data = {"w": WIDTH, "h": HEIGHT, "fps": 60, "K": K.T.ravel().tolist(), "poses": quaternions}
    (root / "metadata.json").write_text(json.dumps(data))


def scanner_app(root: Path, pictures: Pictures, poses: Poses) -> None:
    """3D Scanner App, "all data": everything in one folder."""
    for index, (picture, pose) in enumerate(zip(pictures, poses, strict=True)):
        save(root / f"frame_{index:05d}.jpg", picture)
        save(root / f"thumb_{index:05d}.jpg", cv2.resize(picture, (80, 60)))
        depth(root / f"depth_{index:05d}.png")
        confidence(root / f"conf_{index:05d}.png")
        data = {"cameraPoseARFrame": (pose @ OPENGL).ravel().tolist(), "intrinsics": K.ravel().tolist()}
        (root / f"frame_{index:05d}.json").write_text(json.dumps(data))
    (root / "info.json").write_text("{}")


def scannet(root: Path, pictures: Pictures, poses: Poses) -> None:
    """ScanNet, after its SensReader. Tracking was lost in the last frame."""
    for folder in ("intrinsic", "pose"):
        (root / folder).mkdir(parents=True)
    camera = np.eye(4)
    camera[:3, :3] = K
    (root / "intrinsic/intrinsic_color.txt").write_text("\n".join(words(*row) for row in camera))
    for index, (picture, pose) in enumerate(zip(pictures, poses, strict=True)):
        save(root / f"color/{index}.jpg", picture)
        depth(root / f"depth/{index}.png")
        lost = np.full((4, 4), -np.inf) if index == len(poses) - 1 else pose
        (root / f"pose/{index}.txt").write_text("\n".join(words(*row) for row in lost))


def seven_scenes(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Microsoft's 7-Scenes: everything in one folder, no camera."""
    for index, (picture, pose) in enumerate(zip(pictures, poses, strict=True)):
        name = f"frame-{index:06d}"
        save(root / f"{name}.color.png", picture)
        depth(root / f"{name}.depth.png")
        (root / f"{name}.pose.txt").write_text("\n".join("\t".join(map(str, row)) for row in pose))


def iphone(root: Path, pictures: Pictures, poses: Poses) -> None:
    """A phone's card after photograph 9999."""
    for index, picture in enumerate(pictures):
        number = 9996 + index if index < 4 else index - 3
        folder = "100APPLE" if index < 4 else "101APPLE"
        save(root / f"DCIM/{folder}/IMG_{number:04d}.JPG", picture)


def two_cameras(root: Path, pictures: Pictures, poses: Poses) -> None:
    """A rig whose cameras have a folder each."""
    for index, picture in enumerate(pictures):
        save(root / f"images/cam{index % 2}/{index // 2:04d}.png", picture)


def reduced_copies(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Folders of photographs, of small copies for the web, and of the same in another format."""
    for index, picture in enumerate(pictures):
        save(root / f"full/{index:04d}.jpg", picture)
        save(root / f"tiff/{index:04d}.tif", picture)
        save(root / f"web/{index:04d}.jpg", cv2.resize(picture, (WIDTH // 2, HEIGHT // 2)))
        save(root / f"thumbs/{index:04d}.jpg", cv2.resize(picture, (32, 24)))


def masks_beside(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Masks next to their photographs, some in colour, as several programs save them."""
    for index, picture in enumerate(pictures):
        save(root / f"{index:04d}.jpg", picture)
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:60] = 0
        save(root / f"{index:04d}_mask.png", mask if index % 2 else cv2.cvtColor(mask, cv2.COLOR_GRAY2BGR))


def masks_of_the_same_stem(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Masks in black and white with the names of their photographs."""
    for index, picture in enumerate(pictures):
        save(root / f"{index:04d}.jpg", picture)
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:60] = 0
        save(root / f"{index:04d}.png", mask)


def white_masks_of_the_same_stem(root: Path, pictures: Pictures, poses: Poses) -> None:
    """The same as white pictures with the mask in their alpha."""
    for index, picture in enumerate(pictures):
        save(root / f"{index:04d}.jpg", picture)
        mask = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
        mask[:60, :, 3] = 0
        save(root / f"{index:04d}.png", mask)


def previews_at_the_top(root: Path, pictures: Pictures, poses: Poses) -> None:
    for index, picture in enumerate(pictures):
        save(root / f"shots/{index:04d}.jpg", picture)
    for index in range(2):
        save(root / f"cover_{index}.jpg", cv2.resize(pictures[index], (96, 72)))


def metashape(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Photographs, and masks that Metashape exported."""
    for index, picture in enumerate(pictures):
        save(root / f"photos/{index:04d}.jpg", picture)
        save(root / f"mask/{index:04d}_mask.png", np.full((HEIGHT, WIDTH), 255, np.uint8))


def scannetpp(root: Path, pictures: Pictures, poses: Poses) -> None:
    """ScanNet++, the part of the iPhone, with its masks of faces."""
    for index, picture in enumerate(pictures):
        save(root / f"iphone/rgb/frame_{index:06d}.jpg", picture)
        save(root / f"iphone/rgb_masks/frame_{index:06d}.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
        depth(root / f"iphone/depth/frame_{index:06d}.png")


def monocular_maps(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Photographs next to normals and labels in colour, as networks write them."""
    for index, picture in enumerate(pictures):
        save(root / f"rgb/{index:04d}.jpg", picture)
        save(root / f"normal/{index:04d}.png", picture[::-1])
        save(root / f"semantic/{index:04d}.jpg", picture[:, ::-1])


def edited_and_downloaded_twice(root: Path, pictures: Pictures, poses: Poses) -> None:
    """iPhone photographs with edited versions, those of Google Photos, and a second download."""
    for index, picture in enumerate(pictures):
        save(root / f"IMG_{index:04d}.JPG", picture)
    save(root / "IMG_E0001.JPG", pictures[1][::-1])
    save(root / "IMG_0002-edited.JPG", pictures[2][::-1])
    save(root / "IMG_0003 (1).JPG", pictures[3])


def realsense(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Intel RealSense's recorder: a folder per sensor. The second infrared sensor was saved in colour."""
    for index, picture in enumerate(pictures):
        save(root / f"color/{index:06d}.jpg", picture)
        depth(root / f"depth/{index:06d}.png")
        save(root / f"infrared/{index:06d}.png", cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
        save(root / f"infrared2/{index:06d}.png", picture)


def realsense_viewer(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Snapshots of Intel's viewer: all sensors in one folder."""
    for index, picture in enumerate(pictures):
        save(root / f"room_Color_{index}.png", picture)
        depth(root / f"room_Depth_{index}.png")
        save(root / f"room_Infrared_{index}.png", picture)


def azure_kinect(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Azure Kinect: infrared of 16 bits, smaller than the colour."""
    for index, picture in enumerate(pictures):
        save(root / f"color/{index:05d}.jpg", picture)
        depth(root / f"depth/{index:05d}.png")
        save(root / f"ir/{index:05d}.png", cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(np.uint16) * 16)


def maps_by_name(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Photographs, normals and depth in colour in one folder, as networks write them."""
    for index, picture in enumerate(pictures):
        save(root / f"{index:04d}_rgb.png", picture)
        save(root / f"{index:04d}_normal.png", picture[::-1])
        save(root / f"depth_{index:04d}.png", cv2.applyColorMap(picture[:, :, 0], cv2.COLORMAP_JET))


def hypersim(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Hypersim's previews: maps of several kinds in a second folder."""
    for index, picture in enumerate(pictures):
        save(root / f"images/scene_cam_00_final_preview/frame.{index:04d}.tonemap.jpg", picture)
        for kind in ("normal_cam", "semantic"):
            maps = root / "images/scene_cam_00_geometry_preview"
            save(maps / f"frame.{index:04d}.{kind}.jpg", picture[::-1])


def dtu(root: Path, pictures: Pictures, poses: Poses) -> None:
    """DTU, as NeuS has it: other zeros in the names of the masks."""
    for index, picture in enumerate(pictures):
        save(root / f"image/{index:06d}.png", picture)
        save(root / f"mask/{index:03d}.png", np.full((HEIGHT, WIDTH, 3), 255, np.uint8))


def dji_thermal(root: Path, pictures: Pictures, poses: Poses) -> None:
    """A drone with a thermal camera: both lenses in one folder."""
    for index, picture in enumerate(pictures):
        save(root / f"DCIM/DJI_001/DJI_20240101_{index:04d}_V.JPG", picture)
        save(root / f"DCIM/DJI_001/DJI_20240101_{index:04d}_T.JPG", picture[:200, ::-1])


def photogrammetry(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Photographs next to what programs made of them, and to a screenshot."""
    for index, picture in enumerate(pictures):
        save(root / f"photos/{index:04d}.jpg", picture)
        save(root / f"output/3f2a/train/ours_7000/renders/{index:05d}.png", picture[::-1])
        for work in ("MeshroomCache/PrepareDenseScene/1", "room.files/0/0", "odm_report"):
            save(root / f"{work}/{index + 77}.png", picture[:, ::-1])
    (root / "output/3f2a/cfg_args").touch()
    save(root / "export/model_diffuse.png", pictures[0][:200, :200])
    save(root / "Screenshot_20240101.png", pictures[0][:, :100])


def exported(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Photographs, and the developed ones of darktable."""
    for index, picture in enumerate(pictures):
        save(root / f"DSC{index:04d}.JPG", picture)
        save(root / f"darktable_exported/DSC{index:04d}.jpg", cv2.convertScaleAbs(picture, alpha=1.2))


def upscaled(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Photographs, and what networks made of them."""
    for index, picture in enumerate(pictures):
        save(root / f"room/{index:04d}.png", picture)
        save(root / f"upscaled_2x/{index:04d}.png", cv2.resize(picture, (2 * WIDTH, 2 * HEIGHT)))
        save(root / f"renders/{index:04d}.png", picture[::-1])


def blended_mvs(root: Path, pictures: Pictures, poses: Poses) -> None:
    """BlendedMVS: each picture also with a black background."""
    for index, picture in enumerate(pictures):
        save(root / f"blended_images/{index:08d}.jpg", picture)
        save(root / f"blended_images/{index:08d}_masked.jpg", picture // 2)


def sony(root: Path, pictures: Pictures, poses: Poses) -> None:
    """A Sony's card: a small picture of each video."""
    for index in range(4):
        clip(root / f"PRIVATE/M4ROOT/CLIP/C{index:04d}.MP4", pictures)
        save(root / f"PRIVATE/M4ROOT/THMBNL/C{index:04d}T01.JPG", cv2.resize(pictures[index], (160, 120)))


def insta360(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Flat video of an Insta360, with its small copy."""
    clip(root / "VID_20240101_120000_00_001.mp4", pictures)
    clip(root / "LRV_20240101_120000_01_001.mp4", pictures)


def edited_video(root: Path, pictures: Pictures, poses: Poses) -> None:
    """A video with a proxy of a video editor, the same in another format, and a film in a folder below."""
    clip(root / "walk.mp4", pictures)
    clip(root / "walk.mkv", pictures[:3])
    clip(root / "Proxies/walk.mp4", pictures)
    clip(root / "old/film.mp4", pictures)


def live_photographs(root: Path, pictures: Pictures, poses: Poses) -> None:
    """An iPhone's live photographs: a short video of each."""
    for index, picture in enumerate(pictures):
        save(root / f"IMG_{index:04d}.JPG", picture)
        (root / f"IMG_{index:04d}.MOV").touch()


def nerfcapture_offline(root: Path, pictures: Pictures, poses: Poses) -> None:
    """NeRFCapture's offline mode: names without endings, and the entries of its Manifest.swift."""
    nerfcapture(root, pictures, poses)
    camera = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    frames = []
    for index, pose in enumerate(poses):
        names = {"file_path": f"images/{index}", "depth_path": f"images/{index}.depth.png"}
        frames.append({**names, "transform_matrix": (pose @ OPENGL).tolist(), "timestamp": 0.1, **camera})
    (root / "transforms.json").write_text(json.dumps({**camera, "depth_integer_scale": 1, "frames": frames}))


def contact_sheet(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Photographs with a contact sheet, larger than each."""
    for index, picture in enumerate(pictures):
        save(root / f"IMG_{index:04d}.jpg", picture)
    save(root / "Contact Sheet.jpg", np.vstack([np.hstack(pictures[:3]), np.hstack(pictures[3:6])]))


def gopro(root: Path, pictures: Pictures, poses: Poses) -> None:
    """A GoPro's card: two chapters of a video, each with a small copy and a preview."""
    for chapter in (1, 2):
        clip(root / f"DCIM/100GOPRO/GX0{chapter}0123.MP4", pictures)
        small = root / f"DCIM/100GOPRO/GL0{chapter}0123.LRV"
        small.write_bytes((root / f"DCIM/100GOPRO/GX0{chapter}0123.MP4").read_bytes())
        (small.with_name(f"GX0{chapter}0123.THM")).write_bytes(b"\xff\xd8\xff")


def dji(root: Path, pictures: Pictures, poses: Poses) -> None:
    """A DJI's card: a video with its small copy and its subtitles, and the folder of previews."""
    clip(root / "DCIM/DJI_001/DJI_20240101120000_0001_D.MP4", pictures)
    (root / "DCIM/DJI_001/DJI_20240101120000_0001_D.LRF").write_bytes(b"small")
    (root / "DCIM/DJI_001/DJI_20240101120000_0001_D.SRT").write_text("1")
    (root / "MISC/THM/100").mkdir(parents=True)
    (root / "MISC/THM/100/DJI_0001.THM").write_bytes(b"\xff\xd8\xff")


def dji_panorama(root: Path, pictures: Pictures, poses: Poses) -> None:
    """A drone's photographs, and a panorama that it took from one spot, with equal names."""
    for index, picture in enumerate(pictures):
        save(root / f"DCIM/100MEDIA/DJI_{index + 1:04d}.JPG", picture)
        save(root / f"DCIM/PANORAMA/100_0001/DJI_{index + 1:04d}.JPG", picture[:200, ::-1])


def dji_multispectral(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Mavic 3 Multispectral: each photograph also in four bands of 16 bits."""
    for index, picture in enumerate(pictures):
        save(root / f"DJI_20240101_{index:04d}_D.JPG", picture)
        for band in ("G", "R", "RE", "NIR"):
            save(root / f"DJI_20240101_{index:04d}_MS_{band}.TIF", picture[..., 0].astype(np.uint16) * 99)


def micasense(root: Path, pictures: Pictures, poses: Poses) -> None:
    """MicaSense RedEdge: five bands of 16 bits, no picture in colour."""
    for index, picture in enumerate(pictures):
        for band in range(1, 6):
            values = picture[..., band % 3].astype(np.uint16) * 200
            save(root / f"0000SET/000/IMG_{index:04d}_{band}.tif", values)


def many_bands(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Photographs, and TIFF files with five bands each."""
    for index, picture in enumerate(pictures):
        save(root / f"rgb/{index:04d}.jpg", picture)
        (root / "bands").mkdir(exist_ok=True)
        write_many_bands(root / f"bands/{index:04d}.tif")


def write_many_bands(path: Path) -> None:
    values = np.zeros((48, 64, 5), np.uint16)
    image = OpenImageIO.ImageOutput.create(str(path))
    image.open(str(path), OpenImageIO.ImageSpec(64, 48, 5, "uint16"))
    image.write_image(values)
    image.close()


def matterport(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Matterport3D: pictures of its cameras, the six sides of each panorama, and depth."""
    for index, picture in enumerate(pictures):
        name = f"0e6e6b0332d745178dd37fc1d4a710a{index // 5}"
        save(root / f"undistorted_color_images/{name}_i{index % 3}_{index % 5}.jpg", picture)
        depth(root / f"undistorted_depth_images/{name}_d{index % 3}_{index % 5}.png")
        save(root / f"undistorted_normal_images/{name}_d{index % 3}_{index % 5}_nx.png", picture[::-1])
    for side in range(6):
        save(root / f"matterport_skybox_images/{name}_skybox{side}_sami.jpg", pictures[side][:240, :240])


def pixel_portraits(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Portraits of two versions of a Pixel's camera: sharp, and with a blurred background."""
    for index, picture in enumerate(pictures):
        blurred = cv2.GaussianBlur(picture, None, 9)
        if index % 2:
            name = f"PXL_20240101_1200{index:02d}000.PORTRAIT"
            save(root / f"{name}-01.COVER.jpg", blurred)
            save(root / f"{name}-02.ORIGINAL.jpg", picture)
        else:
            burst = f"BURST202001011200{index:02d}000"
            save(root / f"IMG_{index}/00000PORTRAIT_00000_{burst}.jpg", picture)
            save(root / f"IMG_{index}/00100lPORTRAIT_00100_{burst}_COVER.jpg", blurred)


def raw_and_jpeg(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Photographs in two formats (also of a Pixel), one twice, and overlays of a segmentation."""
    for index, picture in enumerate(pictures):
        name = (f"DSC{index:04d}", f"DSC{index:04d}")
        if index % 2:
            name = (f"PXL_{index:04d}.RAW-01.COVER", f"PXL_{index:04d}.RAW-02.ORIGINAL")
        save(root / f"{name[0]}.jpg", picture)
        (root / f"{name[1]}.dng").write_bytes(b"II*\0")
        save(root / f"sam_vis/{name[0]}_vis.png", picture // 2)
    save(root / "DSC0002 2.jpg", pictures[2])


def euroc(root: Path, pictures: Pictures, poses: Poses) -> None:
    """EuRoC MAV: two grey cameras, and lists of times."""
    for index, picture in enumerate(pictures):
        for camera in (0, 1):
            name = f"mav0/cam{camera}/data/{1403636579763555584 + 50000000 * index}.png"
            save(root / name, cv2.cvtColor(np.roll(picture, 9 * camera, 1), cv2.COLOR_BGR2GRAY))
    (root / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename")
    (root / "mav0/cam0/sensor.yaml").write_text("camera_model: pinhole")


def kitti(root: Path, pictures: Pictures, poses: Poses) -> None:
    """KITTI odometry: two grey and two colour cameras."""
    for index, picture in enumerate(pictures):
        for camera in range(4):
            grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
            seen = grey if camera < 2 else np.roll(picture, 9 * camera, 1)
            save(root / f"image_{camera}/{index:06d}.png", seen)
    (root / "calib.txt").write_text("P0: 1 0 0 0")


def replica(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Replica, as NICE-SLAM rendered it."""
    for index, picture in enumerate(pictures):
        save(root / f"results/frame{index:06d}.jpg", picture)
        depth(root / f"results/depth{index:06d}.png")
    (root / "traj.txt").write_text("\n".join(words(*pose.ravel()) for pose in poses))


def hypernerf(root: Path, pictures: Pictures, poses: Poses) -> None:
    """Nerfies and HyperNeRF: the pictures in four sizes."""
    for index, picture in enumerate(pictures):
        for factor in (1, 2, 4, 8):
            small = cv2.resize(picture, (WIDTH // factor, HEIGHT // factor))
            save(root / f"rgb/{factor}x/{index + 1:06d}.png", small)
    (root / "dataset.json").write_text("{}")


def arkit_scenes(root: Path, pictures: Pictures, poses: Poses) -> None:
    """ARKitScenes: a lens in two sizes, another lens, depth and confidence."""
    for index, picture in enumerate(pictures):
        name = f"40753679_{6791 + index / 10:.3f}.png"
        save(root / "vga_wide" / name, picture)
        save(root / "lowres_wide" / name, cv2.resize(picture, (WIDTH // 2, HEIGHT // 2)))
        save(root / "ultrawide" / name, picture[::-1])
        depth(root / "lowres_depth" / name)
        confidence(root / "confidence" / name)


def opensfm(root: Path, pictures: Pictures, poses: Poses) -> None:
    """OpenSfM and ODM: pictures that they undistorted, and those of their reports."""
    for index, picture in enumerate(pictures):
        save(root / f"images/{index:04d}.jpg", picture)
        save(root / f"undistorted/images/{index:04d}.jpg", picture)
        save(root / f"opensfm/undistorted/images/{index:04d}.tif", picture)
    save(root / "stats/topview.png", pictures[0][:100])
    (root / "reconstruction.json").write_text("[]")


def kiri(root: Path, pictures: Pictures, poses: Poses) -> None:
    """KIRI Engine: the photographs, and the mesh with its texture."""
    for index, picture in enumerate(pictures):
        save(root / f"photos/{index + 1}.jpg", picture)
    save(root / "3DModel.jpg", np.vstack([np.hstack(pictures[:2]), np.hstack(pictures[2:4])]))
    for end in ("obj", "mtl"):
        (root / f"3DModel.{end}").write_text("")


def eth3d(root: Path, pictures: Pictures, poses: Poses) -> None:
    """ETH3D's photographs, with COLMAP's text files in a folder of another name."""
    for index, picture in enumerate(pictures):
        save(root / f"images/dslr_images_undistorted/DSC_{index:04d}.JPG", picture)
    names = [f"dslr_images_undistorted/DSC_{index:04d}.JPG" for index in range(len(pictures))]
    colmap_text(root / "dslr_calibration_undistorted", names, poses)


def scannetpp_dslr(root: Path, pictures: Pictures, poses: Poses) -> None:
    """ScanNet++, the part of the camera, with COLMAP's text files in colmap/."""
    for index, picture in enumerate(pictures):
        save(root / f"resized_images/DSC{index:05d}.JPG", picture)
    colmap_text(root / "colmap", [f"DSC{index:05d}.JPG" for index in range(len(pictures))], poses)


def colmap_text(folder: Path, names: Sequence[str], poses: Poses) -> None:
    """Cameras and poses, without points."""
    folder.mkdir(parents=True)
    camera = words(1, "PINHOLE", WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    (folder / "cameras.txt").write_text(camera + "\n")
    lines = []
    for index, (name, pose) in enumerate(zip(names, poses, strict=True)):
        to_camera = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(to_camera[:3, :3]).as_quat().tolist()
        lines += [words(index + 1, w, x, y, z, *to_camera[:3, 3].tolist(), 1, name), ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("")
