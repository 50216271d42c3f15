"""The scenes of a report: packed for the browser, the poses its viewers know, and a still in their place.

The viewer is PlayCanvas's. It turns every PLY by 180 degrees about z, so that our y down becomes its y up;
poses are turned alike. Its cameras have no roll: a still that stands for a viewer is that of `level_camera`.
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

from cleargs.report.frames import FrameRow, camera_of
from cleargs.splat.camera import Camera, look_at
from cleargs.splat.compressed_ply import compressed_ply
from cleargs.splat.constants import SH_DEGREES
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene

BYTES = 10_000_000
"""Most that a scene of up to half a million Gaussians may take; SH degrees that do not fit are left out."""

_VIEWER = Path(__file__).parent / "static" / "viewer"
_TURN = np.array([-1.0, -1.0, 1.0])
_SECONDS_PER_FRAME = 0.4  # of the flight along the trajectory
_INVISIBLE = 0.5 / 255.0  # opacities below this are stored as 0
_BASE64, _GZIP = 4 / 3, 0.9  # at worst, of what was measured on trained scenes


def shown_degree(gaussians: int, sh_degree: int) -> int:
    """The largest SH degree up to ``sh_degree`` with which so many Gaussians stay below `BYTES`."""
    for coefficients, degree in sorted(SH_DEGREES.items(), reverse=True):
        size = gaussians * (16 + 3 * (coefficients - 1)) * _BASE64 * _GZIP
        if degree <= sh_degree and size <= BYTES:
            return degree
    return 0


def write_scene(path: Path, name: str, scene: Scene) -> int:
    """Write ``scene`` as a script that gives it to the page under ``name``; returns the SH degree kept.

    A page from a disk may load scripts, but not read files.
    """
    gaussians = scene.gaussians
    visible = torch.sigmoid(gaussians.logit_opacities) >= _INVISIBLE
    degree = shown_degree(int(visible.sum()), gaussians.sh_degree)
    kept = gaussians.select(visible)
    kept = Gaussians(**{**kept.tensors(), "sh": kept.sh[:, : (degree + 1) ** 2].contiguous()})
    packed = gzip.compress(compressed_ply(Scene(kept)), 6, mtime=0)
    path.write_bytes(_script(name, packed))
    return degree


def write_viewer(folder: Path) -> str:
    """Write the vendored viewer as a script, with its licence; returns its name and version."""
    (folder / "viewer.js").write_bytes(_script("viewer", (_VIEWER / "index.js.gz").read_bytes()))
    (folder / "viewer-LICENSE.txt").write_bytes((_VIEWER / "LICENSE").read_bytes())
    return (_VIEWER / "VERSION").read_text(encoding="utf-8").strip()


def _script(name: str, packed: bytes) -> bytes:
    return b'(window.packed ??= {})["%s"] = "%s";\n' % (name.encode(), base64.b64encode(packed))


def viewer_pose(camera: Camera) -> dict[str, Any]:
    """``camera`` as the viewer takes it: position, target, field of view of the longer side in degrees."""
    forward = camera.world_to_camera[2, :3]
    side, focal = (camera.width, camera.fx) if camera.width > camera.height else (camera.height, camera.fy)
    return {
        "position": (camera.centre * _TURN).tolist(),
        "target": ((camera.centre + forward) * _TURN).tolist(),
        "fov": float(np.degrees(2.0 * np.arctan(0.5 * side / focal))),
    }


def level_camera(camera: Camera, width: int, height: int) -> Camera:
    """What the viewer shows at `viewer_pose` in a canvas of this size: no roll, the axis in the middle."""
    target = camera.centre + camera.world_to_camera[2, :3]
    pose = look_at(camera.centre, target, np.array([0.0, -1.0, 0.0]))
    side, focal = (camera.width, camera.fx) if camera.width > camera.height else (camera.height, camera.fy)
    focal *= max(width, height) / side
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


def opening(placed: Sequence[FrameRow]) -> FrameRow:
    """The frame that the viewers open at: of the heaviest, the one halfway along."""
    weights = [row.weight or 0.0 for row in placed]
    heaviest = [row for row, weight in zip(placed, weights, strict=True) if weight >= 0.95 * max(weights)]
    return heaviest[len(heaviest) // 2]


def viewer_data(
    placed: Sequence[FrameRow], scenes: Sequence[Mapping[str, Any]]
) -> tuple[dict[str, Any], dict[int, float]]:
    """The settings of the two viewers (SuperSplat Viewer's schema, version 2), and their scenes.

    The trajectory is an animation track: its keys are the frames' poses, to which the page goes by the times
    that are also returned, by frame.
    """
    poses = {row.frame.frame_id: viewer_pose(camera_of(row.frame)) for row in placed}
    times = {frame_id: index * _SECONDS_PER_FRAME for index, frame_id in enumerate(poses)}
    start = opening(placed).frame.frame_id
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
        "scenes": [{name: scene[name] for name in ("key", "antialias", "background")} for scene in scenes],
        "start": times[start],
        "settings": {
            **json.loads((_VIEWER / "settings.json").read_text(encoding="utf-8")),
            "background": {"color": list(scenes[-1]["background"])},
            "animTracks": [track],
            "cameras": [{"initial": poses[start]}],
            "annotations": [],
            "startMode": "animTrack",
        },
    }
    return data, times
