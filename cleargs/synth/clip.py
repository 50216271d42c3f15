"""A video of a walk at any frame rate, in a fraction of the time of exact exposures.

A frame of the video is ray-cast once, at the middle of its exposure, with few rays per pixel. Its motion blur
and rolling shutter come from moving the pixels of that view along the path, by their depth. So surfaces that
are hidden at the middle of the exposure are missing, within a blur's length of the edges in front of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from cleargs.errors import InputError
from cleargs.media.encode import write_video
from cleargs.progress import Reporter
from cleargs.random_streams import Stream
from cleargs.synth.image_motion import track_motion
from cleargs.synth.optics import PINHOLE, Lens, Shutter, distorted
from cleargs.synth.path import HandheldPath, SceneSetup, frame_times
from cleargs.synth.phone import Look, develop
from cleargs.synth.protocols import Fault, Protocol
from cleargs.types import ArrayF64, ImageU8

RAYS = 2
"""Rays per pixel of a frame."""
DEPTH_STEP = 4
"""Pixels between the points whose depth is computed."""
MAX_VIEWS = 16
"""Most views that make up the blur of a frame."""
BITS_PER_PIXEL = 0.3
"""Mean rate of a phone's video over a second, as at 1080p and 30 frames per second."""


def write_clip(
    out: Path,
    setup: SceneSetup,
    rules: Protocol,
    path: HandheldPath,
    faults: Sequence[Fault],
    *,
    look: Look,
    fps: float,
    seed: int,
    reporter: Reporter,
) -> None:
    """Write a video of a whole walk.

    Args:
        out: The MP4 file.
        setup: The world and the lens.
        rules: The protocol. Exposure and readout times are the same for all frames.
        path: The walk.
        faults: Faults of evenly spaced frames of the walk. Their exposure errors are interpolated.
        look: Look of the camera.
        fps: Frames per second.
        seed: Seed of the noise.
        reporter: Receives the progress.

    Raises:
        InputError: if an exposure is longer than the time between frames, or differs between frames.
    """
    fault = faults[0]
    if rules.mixed or fault.exposure * fps > 1:
        raise InputError(
            f"no video of {fps:g} frames per second has exposures of {fault.exposure:.3f} s",
            hint="choose the protocol phone or sharp, or fewer frames per second",
        )
    times = frame_times(max(1, round(path.duration * fps)), fps)
    stops = np.interp(
        times, frame_times(len(faults), len(faults) / path.duration), [fault.stops for fault in faults]
    )

    def shots() -> Iterator[ImageU8]:
        with reporter.task("synth video", len(times)) as task:
            for number, time in enumerate(times):
                light = _exposure(setup, path, float(time), fault)
                if any(rules.distortion):
                    light = distorted(light, setup.lens, rules.distortion)
                rng = np.random.default_rng([seed, Stream.EXPOSURES, number, 1])
                yield develop(light, stops=float(stops[number]), noise=fault.noise, rng=rng, look=look)
                task.advance()

    write_video(out, shots(), fps, BITS_PER_PIXEL if rules.phone else None)


def _exposure(setup: SceneSetup, path: HandheldPath, time: float, fault: Fault) -> ArrayF64:
    """Return the linear light [H, W, 3] of the exposure around ``time``, in seconds."""
    lens, pose = setup.lens, path.poses(np.array([time]))[0]
    instant = Shutter(pose[None], np.zeros((RAYS, lens.height), np.intp), np.array([time]))
    if setup.film is not None:
        light, _ = setup.film(instant, lens, PINHOLE)
    else:
        light = setup.world.render(instant, lens)
    if not fault.exposure and not fault.readout:
        return light
    depth = setup.world.depth(pose, _coarse(lens))
    dense = cv2.resize(depth, (lens.width, lens.height), interpolation=cv2.INTER_NEAREST)
    shutter = track_motion(path, time, np.asarray(dense, np.float64), lens).shutter(
        fault.exposure, fault.readout
    )
    step = -(-shutter.samples // MAX_VIEWS)
    offset = (shutter.samples - 1) % step // 2  # the views that are kept stay centred
    return moved(light, depth, pose, lens, replace(shutter, index=shutter.index[offset::step]))


def moved(
    light: ArrayF64,  # [H, W, 3]
    depth: ArrayF64,  # [h, w]
    pose: ArrayF64,  # [3, 4]
    lens: Lens,
    shutter: Shutter,
) -> ArrayF64:  # [H, W, 3]
    """Return the mean of the views of ``shutter``, made by moving the pixels of one view.

    Args:
        light: Linear light of the view.
        depth: Camera z of evenly spaced points of the view, world units; 0 without a surface.
        pose: Pose of the view, camera to world.
        lens: Lens of ``light``.
        shutter: Poses of all rows in all samples, near ``pose``.
    """
    rows, columns = depth.shape
    x, y = np.meshgrid(
        (np.arange(columns) + 0.5) / columns * lens.width, (np.arange(rows) + 0.5) / rows * lens.height
    )
    z = np.where(depth > 0, depth, 1e6)  # without a surface: far away
    rays = np.stack([(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, np.ones_like(x)], -1)
    points = (rays * z[..., None]) @ pose[:, :3].T + pose[:, 3]
    size, source = (lens.width, lens.height), light.astype(np.float32)
    pixels = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), -1).astype(np.float32)
    total = np.zeros_like(source)
    for index in shutter.index:
        poses = shutter.poses[index[y[:, 0].astype(int)]]  # one per row of points
        local = np.einsum("hwk,hkj->hwj", points - poses[:, None, :, 3], poses[:, :, :3])
        seen = [
            lens.fx * local[..., 0] / local[..., 2] + lens.cx,
            lens.fy * local[..., 1] / local[..., 2] + lens.cy,
        ]
        flow = np.stack([seen[0] - x, seen[1] - y], -1).astype(np.float32)
        x_map, y_map = cv2.split(pixels - cv2.resize(flow, size, interpolation=cv2.INTER_LINEAR))
        total += cv2.remap(source, x_map, y_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(total / shutter.samples, np.float64)


def _coarse(lens: Lens) -> Lens:
    """Return the lens whose pixels are `DEPTH_STEP` times as large, or slightly more."""
    width, height = lens.width // DEPTH_STEP, lens.height // DEPTH_STEP
    wide, high = width / lens.width, height / lens.height
    return Lens(width, height, lens.fx * wide, lens.fy * high, lens.cx * wide, lens.cy * high)
