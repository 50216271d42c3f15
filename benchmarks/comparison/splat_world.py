"""A trained Gaussian scene as the world of a synthetic capture, as in GS2E; a path along real cameras."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline, make_smoothing_spline

from cleargs.capture.layouts.transforms import read_transforms
from cleargs.capture.tables import load_frames
from cleargs.errors import InputError, StoreError
from cleargs.media.colour import linear_from_srgb
from cleargs.scene.views import camera_of
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.ply import read_ply
from cleargs.splat.scene import Scene
from cleargs.splat.types import Render
from cleargs.synth.optics import PINHOLE, Aperture, Lens, Shutter
from cleargs.synth.path import SceneSetup
from cleargs.types import ArrayF64

OPAQUE = 0.5
"""Minimum alpha of a pixel with a depth."""
SMOOTHING = 0.5
"""Weight of the curvature in the smoothing spline; cameras are one unit of its parameter apart."""
MIN_CAMERAS = 5
"""Minimum number of points for `make_smoothing_spline`."""


class SplatWorld:
    """A Gaussian scene as a `cleargs.synth.optics.World`, in the units of the scene.

    Each pose is rendered once. Rows of the image come from the renders of their poses (rolling shutter).
    Renders are clipped to [0, 1] and averaged in linear light.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._engine = rasteriser_for()

    def render(self, shutter: Shutter, lens: Lens, aperture: Aperture = PINHOLE) -> ArrayF64:
        """Return the mean over the samples of the exposure and the aperture, linear light [H, W, 3].

        For a point of the aperture off the optical axis, the principal point moves too, so that the focus
        plane stays in place.
        """
        points = np.broadcast_to(aperture.points, (shutter.samples, 2))
        shares: defaultdict[tuple[int, float, float], ArrayF64] = defaultdict(lambda: np.zeros(lens.height))
        for row_poses, (right, down) in zip(shutter.index, points, strict=True):
            for number in np.unique(row_poses):
                shares[int(number), float(right), float(down)] += (row_poses == number) / shutter.samples
        total = np.zeros((lens.height, lens.width, 3))
        for (number, right, down), share in shares.items():
            pose = shutter.poses[number].copy()
            pose[:, 3] += pose[:, :2] @ np.array([right, down])
            moved = replace(
                lens,
                cx=lens.cx + lens.fx * right / aperture.focus,
                cy=lens.cy + lens.fy * down / aperture.focus,
            )
            picture = np.clip(self._rendered(pose, moved).image.numpy().astype(np.float64), 0, 1)
            rows = share > 0
            total[rows] += share[rows, None, None] * linear_from_srgb(picture[rows])
        return total

    def depth(self, pose: ArrayF64, lens: Lens) -> ArrayF64:
        """Return the expected depth [H, W] in scene units; 0 for pixels with an alpha below `OPAQUE`.

        Raises:
            InputError: All pixels are below `OPAQUE`.
        """
        rendered = self._rendered(pose, lens, depth=True)
        assert rendered.depth is not None
        alpha = rendered.alpha.numpy().astype(np.float64)
        if (alpha < OPAQUE).all():
            raise InputError(
                "the scene is not visible in a frame of the path",
                hint="give cameras in the coordinates of the scene, or a scene that fills their view",
            )
        mean = rendered.depth.numpy() / np.maximum(alpha, OPAQUE)
        return np.where(alpha >= OPAQUE, mean, 0.0)

    def _rendered(self, pose: ArrayF64, lens: Lens, *, depth: bool = False) -> Render:
        scene, camera = self._scene, _camera(pose, lens)
        return self._engine.forward(
            scene.gaussians, camera, background=scene.background, antialias=scene.antialias, depth=depth
        )


@dataclass(frozen=True)
class CameraCourse:
    """A smoothing spline through real cameras in the order of capture."""

    spline: BSpline
    """Index of a camera -> the 12 numbers of a pose [3, 4]; its rotation is not orthonormal."""
    steps: float
    """Index of the last camera."""
    spacing: float
    """Median distance between consecutive cameras, world units."""

    def poses(self, shares: ArrayF64) -> ArrayF64:
        """Return camera-to-world poses [N, 3, 4] at ``shares`` [N] of the course, from 0 to 1."""
        raw = np.asarray(self.spline(shares * self.steps), np.float64).reshape(-1, 3, 4)
        u, _, vt = np.linalg.svd(raw[:, :, :3])
        return np.concatenate([u @ vt, raw[:, :, 3:]], 2)

    def novel(self, share: float, rng: np.random.Generator) -> ArrayF64:
        """Return a pose [3, 4] that is up to 1.5 spacings off the course along each camera axis."""
        pose: ArrayF64 = self.poses(np.array([share]))[0]
        pose[:, 3] += pose[:, :3] @ rng.uniform(-1.5, 1.5, 3) * self.spacing
        return pose


def camera_course(cameras: Sequence[ArrayF64], frames: int) -> CameraCourse:
    """Return a course along consecutive real cameras.

    The course uses the ``frames`` consecutive cameras whose largest step is smallest. So frames overlap as in
    the real capture, and the course crosses no avoidable gap.

    Args:
        cameras: Camera-to-world poses [3, 4] in the order of capture.
        frames: Number of cameras to follow.

    Raises:
        InputError: There are fewer cameras than frames or than `MIN_CAMERAS`, or all are at one place.
    """
    poses = np.stack(cameras) if cameras else np.empty((0, 3, 4))
    if len(poses) < max(frames, MIN_CAMERAS):
        raise InputError(
            f"{frames} frames cannot follow {len(poses)} cameras",
            hint=f"give --frames at most the number of cameras, and at least {MIN_CAMERAS} cameras",
        )
    used = max(frames, MIN_CAMERAS)
    steps = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(steps, used - 1)
    start = int(np.argmin(windows.max(1)))
    spacing = float(np.median(windows[start]))
    if spacing <= 0:
        raise InputError("all cameras are at one place", hint="give the cameras of a path through the scene")
    stretch = poses[start : start + used].reshape(used, 12)
    spline = make_smoothing_spline(np.arange(used), stretch, lam=SMOOTHING)
    return CameraCourse(spline, float(frames - 1), spacing)


def scene_setup(path: Path, cameras: Path | None, frames: int, width: int, height: int) -> SceneSetup:
    """Return a scene as a world, with a course along its real cameras.

    Args:
        path: The scene file.
        cameras: Source of the cameras (`_read_cameras`); None for the run that contains ``path``, as in
            RUN/STAGE/scene.ply.
        frames: Number of cameras to follow.
        width: Image width in px. The lens of the first camera is scaled and cropped to the image size.
        height: Image height in px.

    Raises:
        InputError: The file is not a scene or is empty, or cameras are missing or too few.
    """
    run = path.absolute().parent.parent  # not resolved: RUN/STAGE is a link into the store
    if cameras is None and not (run / "ingest" / "frames.parquet").is_file():
        if not path.is_file():
            raise InputError(f"{path} does not exist", hint="give a scene.ply")
        raise InputError(
            f"{path} is not in a run, so its cameras are unknown",
            hint="give --cameras DIR, a folder with a transforms.json in the coordinates of the scene",
        )
    world = SplatWorld(_read_scene(path))
    real = _read_cameras(run if cameras is None else cameras)
    course = camera_course([pose for _, pose in real], frames)
    name = path.stem if cameras is not None else run.name
    return SceneSetup(name, world, course, _fit_lens(real[0][0], width, height))


def _fit_lens(lens: Lens, width: int, height: int) -> Lens:
    """Scale a lens until it fills ``width`` x ``height``, and crop the image at its centre."""
    scale = max(width / lens.width, height / lens.height)
    left, top = (lens.width * scale - width) / 2, (lens.height * scale - height) / 2
    cx, cy = lens.cx * scale - left, lens.cy * scale - top
    return Lens(width, height, lens.fx * scale, lens.fy * scale, cx, cy)


def _read_cameras(source: Path) -> list[tuple[Lens, ArrayF64]]:
    """Read lenses and camera-to-world poses [3, 4] in frame order; raise InputError without cameras.

    ``source`` is a run, a transforms.json or a folder that contains one.
    """
    ingest = source / "ingest"
    if (ingest / "frames.parquet").is_file():
        cameras = [camera_of(frame) for frame in load_frames(ingest) if frame.registered]
        return [
            (
                Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy),
                np.column_stack([camera.world_to_camera[:3, :3].T, camera.centre]),
            )
            for camera in cameras
        ]
    transforms = source / "transforms.json" if source.is_dir() else source
    if not transforms.is_file():
        raise InputError(f"{source} contains no cameras", hint="give a transforms.json, its folder, or a run")
    found = []
    for frame in read_transforms(transforms, poses=True):
        assert frame.camera is not None and frame.pose is not None
        lens = Lens(frame.camera.width, frame.camera.height, *frame.camera.focal, *frame.camera.centre)
        found.append((lens, np.column_stack([frame.pose.rotation.T, frame.pose.centre])))
    return found


def _read_scene(path: Path) -> Scene:
    hint = "give a scene.ply in the format of the Inria code"
    try:
        scene = read_ply(path)
    except StoreError as error:
        reason = str(error.__cause__ or error).splitlines()[0]
        raise InputError(f"{path} is not a Gaussian scene: {reason}", hint=hint) from error
    if scene.gaussians.num == 0:
        raise InputError(f"{path} contains no Gaussians", hint=hint)
    return scene


def _camera(pose: ArrayF64, lens: Lens) -> Camera:
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = pose[:, :3].T
    world_to_camera[:3, 3] = -pose[:, :3].T @ pose[:, 3]
    return Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, world_to_camera)
