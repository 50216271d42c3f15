"""The scene of a report: compressed for the browser, with camera poses for the 3D viewer.

The viewer is PlayCanvas's SuperSplat Viewer. It rotates each PLY by 180 degrees about z, so that y points up.
Poses are rotated too. The viewer's cameras have no roll, so the page gives them the rotations of the frames.
"""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from cleargs.named_views import NamedView
from cleargs.report.frames import FrameRow
from cleargs.scene.views import camera_of
from cleargs.splat.camera import Camera
from cleargs.splat.compressed_ply import compressed_ply
from cleargs.splat.constants import SH_DEGREES
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene

SCENE_BYTES = 10_000_000
"""Maximum size of a scene with up to half a million Gaussians. SH degrees that do not fit are left out."""

LICENCE = "viewer-LICENSE.txt"
"""File with the viewer's licence, next to the page."""

_VIEWER = Path(__file__).parent / "static" / "viewer"
_ROTATION = np.array([-1.0, -1.0, 1.0])  # the diagonal of the rotation by 180 degrees about z
_SECONDS_PER_FRAME = 0.4  # in the animation along the trajectory
_INVISIBLE = 0.5 / 255.0  # opacities below this are stored as 0
_BASE64, _GZIP = 4 / 3, 0.9  # size ratios; that of gzip is the worst of the trained scenes measured


def shown_degree(gaussians: int, sh_degree: int) -> int:
    """Return the largest SH degree, at most ``sh_degree``, with which the scene stays below `SCENE_BYTES`."""
    for coefficients, degree in sorted(SH_DEGREES.items(), reverse=True):
        size = gaussians * (16 + 3 * (coefficients - 1)) * _BASE64 * _GZIP
        if degree <= sh_degree and size <= SCENE_BYTES:
            return degree
    return 0


def write_scene(path: Path, name: str, scene: Scene) -> int:
    """Write a scene as a script, which registers it as ``name``. Return the SH degree that was kept.

    A page that is opened from disk may load scripts but not other files.
    """
    gaussians = scene.gaussians
    visible = torch.sigmoid(gaussians.logit_opacities) >= _INVISIBLE
    degree = shown_degree(int(visible.sum()), gaussians.sh_degree)
    shown = gaussians.select(visible)
    shown = Gaussians(**{**shown.tensors(), "sh": shown.sh[:, : (degree + 1) ** 2].contiguous()})
    path.write_bytes(_script(name, gzip.compress(compressed_ply(Scene(shown)), 6, mtime=0)))
    return degree


def write_viewer(folder: Path) -> str:
    """Write the vendored viewer as a script, with its licence, and return its name and version."""
    (folder / "viewer.js").write_bytes(_script("viewer", (_VIEWER / "index.js.gz").read_bytes()))
    (folder / LICENCE).write_bytes((_VIEWER / "LICENSE").read_bytes())
    return (_VIEWER / "VERSION").read_text(encoding="utf-8").strip()


def _script(name: str, packed: bytes) -> bytes:
    return b'(window.packed ??= {})["%s"] = "%s";\n' % (name.encode(), base64.b64encode(packed))


def viewer_pose(camera: Camera) -> dict[str, Any]:
    """Return ``camera`` for the viewer: position, target, and field of view of the longer side in degrees."""
    forward = camera.world_to_camera[2, :3]
    side, focal = (camera.width, camera.fx) if camera.width > camera.height else (camera.height, camera.fy)
    return {
        "position": (camera.centre * _ROTATION).tolist(),
        "target": ((camera.centre + forward) * _ROTATION).tolist(),
        "fov": float(np.degrees(2.0 * np.arctan(0.5 * side / focal))),
    }


def viewer_rotation(camera: Camera) -> list[float]:
    """Return the rotation of ``camera`` in the viewer's world as a quaternion x, y, z, w (OpenGL axes)."""
    right, down, forward = camera.world_to_camera[:3, :3] * _ROTATION
    quaternion: list[float] = Rotation.from_matrix(np.array([right, -down, -forward]).T).as_quat().tolist()
    return quaternion


def opening_frame(placed: Sequence[FrameRow]) -> FrameRow:
    """Return the frame at which the viewers start: the middle one of the frames with the largest weights."""
    weights = [row.weight or 0.0 for row in placed]
    largest = [row for row, weight in zip(placed, weights, strict=True) if weight >= 0.95 * max(weights)]
    return largest[len(largest) // 2]


def viewer_data(
    placed: Sequence[FrameRow], scene: Mapping[str, Any], views: Sequence[NamedView] = ()
) -> tuple[dict[str, Any], dict[int, float]]:
    """Return the settings of the viewer (schema of SuperSplat Viewer, version 2), and frame_id -> time in s.

    The trajectory is an animation track whose keys are the poses of the ``placed`` frames, and after them the
    ``views``. ``scene`` is the data of the scene for the page.
    """
    poses: dict[int | str, dict[str, Any]] = {
        row.frame.frame_id: viewer_pose(camera_of(row.frame)) for row in placed
    }
    times = {row.frame.frame_id: index * _SECONDS_PER_FRAME for index, row in enumerate(placed)}
    fov = next(iter(poses.values()))["fov"]
    for view in views:
        ends = {"position": view.position, "target": view.target}
        poses[view.name] = {name: (np.array(x) * _ROTATION).tolist() for name, x in ends.items()} | {
            "fov": fov
        }
    start = opening_frame(placed).frame.frame_id
    track = {
        "name": "trajectory",
        "duration": _SECONDS_PER_FRAME * len(poses),
        "frameRate": 1 / _SECONDS_PER_FRAME,
        "loopMode": "none",
        "interpolation": "spline",
        "smoothness": 1,
        "keyframes": {
            "times": list(range(len(poses))),
            "values": {
                "position": [x for pose in poses.values() for x in pose["position"]],
                "target": [x for pose in poses.values() for x in pose["target"]],
                "fov": [pose["fov"] for pose in poses.values()],
            },
        },
    }
    data = {
        "antialias": scene["antialias"],
        "step": _SECONDS_PER_FRAME,
        "views": [
            {"name": view.name, "time": (len(placed) + k) * _SECONDS_PER_FRAME}
            for k, view in enumerate(views)
        ],
        "rotations": [viewer_rotation(camera_of(row.frame)) for row in placed],
        "settings": {
            **json.loads((_VIEWER / "settings.json").read_text(encoding="utf-8")),
            "background": {"color": list(scene["background"])},
            "animTracks": [track],
            "cameras": [{"initial": poses[start]}],
            "annotations": [],
            "startMode": "animTrack",
        },
    }
    return data, times
