"""Folders of scanning apps and RGB-D cameras: colour pictures with the poses that the device tracked.

Depth is not read. Poses are tested on the images like all given poses. Sources of the forms: the READMEs of
Stray Scanner's visualiser, Polycam's polyform and ScanNet, nerfstudio's readers of Record3D and Polycam, the
pages of TUM RGB-D and 7-Scenes, and frames that the 3D Scanner App exported.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.contents import contents_of
from cleargs.capture.folders import chosen
from cleargs.capture.layouts import images, video
from cleargs.errors import InputError
from cleargs.media.headers import read_header
from cleargs.safe_io import faults_as, read_json, read_text

_APART_S = 0.02
"""Most seconds between a picture and its pose, as in TUM's associate.py."""

_KINECT, _TUM, _SEVEN = (640, 480), (525.0, 525.0, 319.5, 239.5), (585.0, 585.0, 320.0, 240.0)
"""Size of a Kinect's pictures, and the cameras that the pages of TUM RGB-D and 7-Scenes give for them."""

_HINT = "export the folder again, or set ingest.poses=sfm to find poses from the images"


class _Placed(NamedTuple):
    """Pose and camera of a picture."""

    matrix: Any
    """Camera to world, 3 x 4 or 4 x 4, with OpenCV axes (x right, y down, z forward)."""
    camera: tuple[float, float, float, float]
    """fx, fy, cx, cy, px."""
    size: tuple[int, int] | None = None
    """Size of the pictures that the camera fits; None: that of the stored picture."""


_Poses: TypeAlias = Mapping[Path | int, _Placed]
"""Picture, or number of a frame of the video -> its pose."""


class _App(NamedTuple):
    name: str
    patterns: tuple[str, ...]
    """Files of poses and cameras. If each pattern has a file, the app wrote the folder."""
    read: Callable[[list[Path], Sequence[Path]], _Poses]
    """Function from these files and the pictures to the poses."""
    gravity: bool = False
    """True if y is up in its world, by the phone's sensors (ARKit)."""

    def files(self, source: Path) -> list[Path]:
        """Return the files of poses and cameras below ``source``; none if another app wrote it."""
        found = [sorted(source.glob(pattern)) for pattern in self.patterns]
        return [file for files in found for file in files] if all(found) else []


def detect(source: Path, config: CaptureConfig) -> bool:
    return config.uses_poses and source.is_dir() and _app_of(source) is not None


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    app, contents = _app_of(source), contents_of(source, config)
    assert app is not None
    poses = {file.relative_to(source).as_posix(): file for file in app.files(source)}
    return {
        "poses": poses,
        **({"capture": contents.videos[0]} if contents.is_video else contents.externals()),
    }


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """See `Layout.open_capture`. Pictures without a pose are frames too.

    If the poses cannot be read, the capture has none, and a note: another program may have written the files.
    """
    app, contents = _app_of(source), contents_of(source, config)
    assert app is not None
    try:
        with faults_as(InputError, f"cannot read the poses of {app.name} in {source}", hint=_HINT):
            placed = app.read(app.files(source), contents.photographs)
            if contents.is_video:
                frames = _of_video(contents.videos[0], placed)
            else:
                frames = [_frame(frame, placed.get(frame.path)) for frame in contents.frames()]
    except InputError as error:
        capture: Capture = (video if contents.is_video else images).open_capture(source, config)
        return replace(capture, notes=(*capture.notes, f"{error}; poses are found from the images"))
    if app.gravity:
        frames = [replace(f, up=tuple(f.pose.rotation[:, 1].tolist())) if f.pose else f for f in frames]
    taken = chosen(frames, source, config.max_frames)
    told = f"{contents.told()}; {len(placed)} poses of {app.name}"
    return Capture("rgbd", taken, len(frames), told=told, notes=contents.warnings())


def _of_video(file: Path, placed: _Poses) -> list[SourceFrame]:
    """Return the frames of a video, whose poses have their numbers. Frames without a pose are left out."""
    from cleargs.media.video import read_timeline, video_size

    timeline, size = read_timeline(file), video_size(file)
    numbers = [number for number in range(len(timeline.pts)) if number in placed]
    frames = [video.video_frame(file, timeline, number, file.stem) for number in numbers]
    return [_frame(frame, placed[n]._replace(size=size)) for n, frame in zip(numbers, frames, strict=True)]


def _frame(frame: SourceFrame, placed: _Placed | None) -> SourceFrame:
    import numpy as np

    from cleargs.capture.cameras import pinhole, rigid_pose, within_reach

    if placed is None or not within_reach(np.asarray(placed.matrix, np.float64)):  # tracking was lost
        return frame
    header = read_header(frame.path) if placed.size is None else None
    size = header.size if header is not None else placed.size
    if size is None:
        return frame
    pose = rigid_pose(_opengl(placed.matrix), frame.name, _HINT)
    return replace(frame, camera=pinhole(*size, *placed.camera), pose=pose)


def _app_of(source: Path) -> _App | None:
    return next((app for app in _APPS if app.files(source)), None)


def _turned(values: Sequence[float]) -> Any:  # [3, 4]
    """Return the matrix of x, y, z and a quaternion x, y, z, w."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    return np.column_stack([Rotation.from_quat(values[3:7]).as_matrix(), values[:3]])


def _opengl(matrix: Any) -> Any:
    """Return a matrix with OpenGL's axes (ARKit's) with those of OpenCV, or the other way."""
    import numpy as np

    return np.asarray(matrix, np.float64)[:3] * [1, -1, -1, 1]


def _rows(file: Path) -> list[list[str]]:
    """Return the words of each line; commas separate them too. Lines that start with # are comments."""
    lines = (line.replace(",", " ").split() for line in read_text(file).splitlines())
    return [words for words in lines if words and not words[0].startswith("#")]


def _numbers(file: Path) -> list[list[float]]:
    return [[float(word) for word in row] for row in _rows(file)]


def _camera(matrix: Any) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a camera matrix."""
    return float(matrix[0][0]), float(matrix[1][1]), float(matrix[0][2]), float(matrix[1][2])


def _stray(files: list[Path], _: Sequence[Path]) -> _Poses:
    """Read timestamp, frame, x, y, z, qx, qy, qz, qw of each frame of rgb.mp4."""
    camera = _camera(_numbers(files[0]))
    rows = _rows(files[1])[1:]
    return {int(row[1]): _Placed(_turned([float(x) for x in row[2:9]]), camera) for row in rows}


def _tum(files: list[Path], photographs: Sequence[Path]) -> _Poses:
    """Read time and name of the pictures, and time, x, y, z, qx, qy, qz, qw of the poses."""
    poses = sorted(_numbers(files[1]))
    times = [row[0] for row in poses]
    known = set(photographs)
    placed: dict[Path | int, _Placed] = {}
    for time, name, *_ in _rows(files[0]):
        at = bisect(times, float(time))
        near = min(poses[max(0, at - 1) : at + 1], key=lambda row: abs(row[0] - float(time)))
        path = files[0].parent / name
        if path in known and abs(near[0] - float(time)) <= _APART_S:
            placed[path] = _Placed(_turned(near[1:8]), _TUM, _KINECT)
    return placed


def _record3d(files: list[Path], photographs: Sequence[Path]) -> _Poses:
    """Read K (by columns), w, h and the poses qx, qy, qz, qw, x, y, z of rgb/0.jpg, rgb/1.jpg, ..."""
    data = read_json(files[0])
    fx, _, _, _, fy, _, cx, cy, _ = map(float, data["K"])
    size = int(data["w"]), int(data["h"])
    numbered = ((path, int(path.stem)) for path in photographs if path.stem.isdecimal())
    poses = data["poses"]
    return {
        path: _Placed(_opengl(_turned([*poses[n][4:7], *poses[n][:4]])), (fx, fy, cx, cy), size)
        for path, n in numbered
        if n < len(poses)
    }


def _beside(
    files: list[Path],
    photographs: Sequence[Path],
    name: Callable[[Path], Path],
    read: Callable[[Any], _Placed],
) -> _Poses:
    """Read the JSON file of each picture, which has the path ``name``."""
    known = set(files)
    return {path: read(read_json(name(path))) for path in photographs if name(path) in known}


def _polycam(files: list[Path], photographs: Sequence[Path]) -> _Poses:
    """Read t_00 to t_23, fx, fy, cx, cy, width, height of cameras/NAME.json for images/NAME.jpg."""

    def placed(data: Any) -> _Placed:
        matrix = [[float(data[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
        fx, fy, cx, cy = (float(data[name]) for name in ("fx", "fy", "cx", "cy"))
        return _Placed(_opengl(matrix), (fx, fy, cx, cy), (int(data["width"]), int(data["height"])))

    def name(path: Path) -> Path:
        return path.parent.with_name(path.parent.name.replace("images", "cameras")) / f"{path.stem}.json"

    return _beside(files, photographs, name, placed)


def _scanner(files: list[Path], photographs: Sequence[Path]) -> _Poses:
    """Read cameraPoseARFrame (16 numbers, by rows) and intrinsics (9, by rows) of frame_N.json."""

    def placed(data: Any) -> _Placed:
        pose, k = ([float(x) for x in data[name]] for name in ("cameraPoseARFrame", "intrinsics"))
        return _Placed(_opengl([pose[0:4], pose[4:8], pose[8:12]]), (k[0], k[4], k[2], k[5]))

    return _beside(files, photographs, lambda path: path.with_suffix(".json"), placed)


def _scannet(files: list[Path], photographs: Sequence[Path]) -> _Poses:
    """Read pose/N.txt of color/N.jpg, or N.pose.txt of N.color.png, and intrinsic/intrinsic_color.txt."""
    known = {file.name.partition(".")[0]: file for file in files}
    stated = known.pop("intrinsic_color", None)
    camera, size = (_SEVEN, _KINECT) if stated is None else (_camera(_numbers(stated)), None)
    found = {path: known.get(path.name.partition(".")[0]) for path in photographs}
    return {path: _Placed(_numbers(file), camera, size) for path, file in found.items() if file is not None}


_APPS = (
    _App("Stray Scanner", ("camera_matrix.csv", "odometry.csv"), _stray, gravity=True),
    _App("TUM RGB-D", ("rgb.txt", "groundtruth.txt"), _tum),
    _App("Record3D", ("metadata.json", "rgb/0.*"), _record3d, gravity=True),
    _App("Polycam", ("keyframes/*cameras/*.json",), _polycam, gravity=True),
    _App("Polycam", ("*cameras/*.json",), _polycam, gravity=True),
    _App("3D Scanner App", ("frame_*.json",), _scanner, gravity=True),
    _App("ScanNet", ("pose/*.txt", "intrinsic/intrinsic_color.txt"), _scannet),
    _App("7-Scenes", ("*.pose.txt",), _scannet),
)
