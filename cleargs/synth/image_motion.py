"""Image motion of a frame: length of the blur, skew of a rolling shutter, and poses that sample both."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from cleargs.errors import InputError
from cleargs.synth.optics import MIN_SAMPLES, Lens, Shutter
from cleargs.synth.path import HandheldPath
from cleargs.types import ArrayF64

TRACK_GRID = (24, 14)
"""Columns and rows of the image points that are tracked."""
TRACK_POSES = 33
"""Number of poses at which points are tracked within an exposure."""
FAST_QUANTILE = 0.9
"""Quantile of the motions of the image points that sets the number of samples. Points up to it move by at
most one pixel between samples, so that no separate copies are visible."""
ROW_STEP = 0.25
"""Image motion in pixels between the poses that rows of a rolling shutter share. A row differs from its exact
pose by at most half of it."""


@dataclass(frozen=True)
class SimulatedMotion:
    """Motion of the image around the time of one frame."""

    path: HandheldPath
    time: float
    """Middle of the exposure, seconds."""
    points: ArrayF64  # [P, 3] visible from the middle pose, world coordinates
    lens: Lens

    def blur(self, exposure: float) -> float:
        """Return the mean path length of the points in the image during ``exposure`` seconds, in pixels."""
        return float(self._lengths(exposure).mean())

    def skew(self, readout: float) -> float:
        """Return the mean image distance of the points between the first and last row's poses, in pixels."""
        return float(self._skews(readout).mean())

    def shutter(self, exposure: float, readout: float) -> Shutter:
        """Return the poses of the path that sample an exposure.

        Args:
            exposure: Exposure time of each row, seconds. That of the middle row is centred on ``time``.
            readout: Time from the first to the last row, seconds; 0 for a global shutter.
        """
        height = self.lens.height
        blur = float(np.quantile(self._lengths(exposure), FAST_QUANTILE)) if exposure > 0 else 0.0
        samples = max(MIN_SAMPLES, math.ceil(blur))
        tick, stride = exposure / samples, int(exposure > 0)
        row = np.zeros(height, np.intp)
        if readout > 0:
            skew = float(np.quantile(self._skews(readout), FAST_QUANTILE))
            row_step = readout / max(1, math.ceil(skew / ROW_STEP))
            stride = math.ceil(tick / row_step)
            tick = tick / stride if stride else row_step
            row = np.rint(readout / tick * ((np.arange(height) + 0.5) / height - 0.5)).astype(np.intp)
        index = row[None] + stride * np.arange(samples)[:, None]
        ticks, place = np.unique(index, return_inverse=True)
        times = self.time + (ticks - stride * (samples - 1) / 2) * tick
        return Shutter(self.path.poses(times), place.reshape(index.shape), times)

    def _lengths(self, exposure: float) -> ArrayF64:
        times = self.time + exposure * np.linspace(-0.5, 0.5, TRACK_POSES)
        return np.asarray(np.linalg.norm(np.diff(self._tracks(times), axis=0), axis=2).sum(0))

    def _skews(self, readout: float) -> ArrayF64:
        first, last = self._tracks(self.time + readout * np.array([-0.5, 0.5]))
        return np.asarray(np.linalg.norm(last - first, axis=1))

    def _tracks(self, times: ArrayF64) -> ArrayF64:
        """Return image positions [T, P, 2] in pixels, relative to the principal point."""
        poses = self.path.poses(times)
        local = np.einsum("tpk,tkj->tpj", self.points - poses[:, None, :, 3], poses[:, :, :3])
        focal = np.array([self.lens.fx, self.lens.fy])
        places = local[..., :2] / np.maximum(local[..., 2:], 1e-6)
        if self.lens.fisheye:
            tangents = np.maximum(np.linalg.norm(places, axis=-1, keepdims=True), 1e-12)
            places *= np.arctan(tangents) / tangents
        return np.asarray(focal * places, np.float64)


def track_motion(path: HandheldPath, time: float, depth: ArrayF64, lens: Lens) -> SimulatedMotion:
    """Prepare the points to track around ``time``, where ``depth`` [H, W] is 0 without a surface."""
    columns = (np.arange(TRACK_GRID[0]) + 0.5) / TRACK_GRID[0] * lens.width
    rows = (np.arange(TRACK_GRID[1]) + 0.5) / TRACK_GRID[1] * lens.height
    x, y = np.meshgrid(columns, rows)
    z = depth[y.astype(int), x.astype(int)]
    rays = np.stack([(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, np.ones_like(x)], -1)
    if lens.fisheye:
        angles = np.linalg.norm(rays[..., :2], axis=-1, keepdims=True)
        rays[..., :2] *= np.tan(angles) / angles
    seen = z > 0
    pose = path.poses(np.array([time]))[0]
    return SimulatedMotion(path, time, (rays * z[..., None])[seen] @ pose[:, :3].T + pose[:, 3], lens)


def solve_duration(pixels: float, motion: Callable[[float], float]) -> float:
    """Return the duration in seconds for which the increasing function ``motion`` is ``pixels``; 0 for 0.

    Raises:
        InputError: if it is longer than a minute.
    """
    if pixels <= 0:
        return 0.0
    longest = 1 / 64
    while motion(longest) < pixels:
        longest *= 2
        if longest > 60:
            raise InputError(
                "the camera moves too little for blurred frames",
                hint="choose the protocol sharp, or cameras that move",
            )
    return float(brentq(lambda duration: motion(duration) - pixels, 0.0, longest, xtol=1e-7))
