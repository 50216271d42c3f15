"""The up direction of a scene: stated by the input, against the view of a flight, or that of the pictures."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.model import SparseModel
from cleargs.capture.prepare import WorkFrame
from cleargs.errors import InputError
from cleargs.media.gopro import gravity
from cleargs.safe_io import open_regular

_PARALLEL = math.cos(math.radians(20))
"""Cosine of the angle from the mean view within which nine of ten views count as parallel."""
_FLAT, _HEADINGS, _STRIP = 0.2, 0.5, 1.0
"""Parallel views look down if their centres differ along the view by at most this share of the path, and if
the tops of the pictures cancel to this mean length (a flight that turns), or the path goes this many depths
towards the top of the pictures: nobody films a wall so."""
_SIDEWAYS = 0.3, 0.9
"""The camera may have been held sideways if the top of its pictures has at most the second mean length, its
right axis lacks at most the first share of what the top lacks to 1, and the path is in a plane across the
right axis: a walk turns about what is vertical."""
_ACROSS = 0.9
_LEVEL, _TILTED = (0.2, 0.3), math.cos(math.radians(25))
"""The right axes of level cameras are horizontal. They tell up if they leave their plane by at most the first
share of their smaller spread in it, and this is at least the second share of the larger one. They are used
where the tops of the pictures are more than 25 degrees off: a drone that looks down, then ahead."""

_HEAD = 2**18  # bytes at the start of a JPEG in which its XMP is
_GIMBAL = re.compile(rb"Gimbal(Pitch|Roll)Degree(?:=\"|>)\s*([+-]?\d+(?:\.\d+)?)")

_TURN = "cleargs export --upright FRAME:left (top, right, bottom) turns the scene"


def stated_up(image: Path) -> NDArray[np.float64] | None:  # [3]
    """Return up in the axes of the camera (x right, y down, z ahead) by a drone's XMP in ``image``, or None.

    DJI and others write the pitch of the gimbal, degrees: -90 is straight down. A roll is left out.
    """
    try:
        with open_regular(image) as file:
            found = {name: float(value) for name, value in _GIMBAL.findall(file.read(_HEAD))}
    except (InputError, OSError):
        return None
    pitch = math.radians(found.get(b"Pitch", math.nan))
    if not math.isfinite(pitch) or abs(found.get(b"Roll", 0.0)) > 10:
        return None
    return np.array([0.0, -math.cos(pitch), math.sin(pitch)])


def stated_ups(frames: Sequence[WorkFrame]) -> dict[str, NDArray[np.float64]]:
    """Return working image -> up in the axes of its camera, where a file of the input states it.

    Such files are poses of an app, the XMP of a drone, and the video of a GoPro.
    """
    sources = {frame.image: frame.source for frame in frames}
    found = {name: np.array(source.up) for name, source in sources.items() if source.up is not None}
    for video in dict.fromkeys(source.path for source in sources.values() if source.pts is not None):
        shown = {n: s.pts for n, s in sources.items() if s.path == video and s.pts is not None}
        if (down := gravity(video, list(shown.values()))) is not None:
            found = dict(zip(shown, -down, strict=True)) | found
    for name, source in sources.items():
        if source.pts is None and name not in found and (up := stated_up(source.path)) is not None:
            found[name] = up
    return found


def find_up(
    model: SparseModel, stated: Mapping[str, NDArray[np.float64]]
) -> tuple[NDArray[np.float64] | None, str]:
    """Return up in the world of ``model``, or None where the tops of the pictures tell it, and what to say.

    ``stated`` is image -> up in the axes of its camera. The text is empty where nothing is unusual.
    """
    images = list(model.images.values())
    turns = np.stack([image.pose.rotation for image in images])
    told = [image.pose.rotation.T @ stated[image.name] for image in images if image.name in stated]
    up = np.sum(told, axis=0) if told else np.zeros(3)
    if np.linalg.norm(up) > 0.5 * len(told) > 0:
        return up, "up is what the input states"
    centres = np.stack([image.pose.centre for image in images])
    centres = centres - centres.mean(axis=0)
    right, down, ahead = turns.mean(axis=0)
    lengths = np.linalg.norm([right, down, ahead], axis=1)
    view = ahead / max(lengths[2], 1e-12)
    spread, axes = np.linalg.svd(centres, full_matrices=False)[1:]
    if np.quantile(turns[:, 2] @ view, 0.1) >= _PARALLEL:
        along = float(np.linalg.norm(centres @ view))
        if along > _FLAT * spread[0] or len(images) < 3:
            return None, ""
        depth = float(np.median((model.xyz - np.mean([i.pose.centre for i in images], axis=0)) @ view))
        reach = float(np.ptp(centres @ (down / max(lengths[1], 1e-12))))
        if lengths[1] < _HEADINGS or reach > _STRIP * depth:
            return -view, f"the cameras look straight down: up is against their view (a guess; {_TURN})"
        return (
            None,
            f"all cameras look the same way: the tops of the pictures are treated as up (a guess; {_TURN})",
        )
    plane, normals = np.linalg.svd(turns[:, 0], full_matrices=False)[1:]
    level = plane[2] <= _LEVEL[0] * plane[1] and plane[1] >= _LEVEL[1] * plane[0]
    top = -down / max(lengths[1], 1e-12)
    if level and abs(normals[2] @ top) < _TILTED:
        # Cameras look down rather than up, and the tops of some pictures are up.
        up = normals[2] * np.sign(normals[2] @ (-down - ahead))
        return up, f"up is across the left and right of the pictures (a guess; {_TURN})"
    flat = spread[2] < _FLAT * spread[0] and spread[1] > _FLAT * spread[0]
    across = flat and abs(axes[2] @ right) > _ACROSS * lengths[0]
    if across and lengths[1] <= _SIDEWAYS[1] and 1 - lengths[0] < _SIDEWAYS[0] * (1 - lengths[1]):
        return None, (
            "the camera turns about the left and right of its pictures: it was held sideways, or moved over "
            f"a thing from top to bottom, which is assumed (a guess; {_TURN})"
        )
    return None, ""
