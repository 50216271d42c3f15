"""How far the image moves: the blur of an exposure, the skew of a readout, the shutter that samples both."""

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

GRID = (24, 14)
"""Columns and rows of the points whose motion is followed."""
INSTANTS = 33
"""Poses that trace the motion within an exposure."""
FASTEST = 0.9
"""Quantile of the image points whose motion sets the number of samples: these move by at most a pixel from
sample to sample, so that, with the pixel's own width, no ghost steps show."""
ROW_STEP = 0.25
"""By how many pixels at most the rows of one pose differ from their own, twice: rows share poses in steps
of that size."""


@dataclass(frozen=True)
class SimulatedMotion:
    """One frame's surroundings in time: what an exposure about its middle would smear."""

    path: HandheldPath
    time: float
    """Middle of the exposure, seconds."""
    points: ArrayF64  # [P, 3] that the middle pose sees, in the world
    lens: Lens

    def blur(self, exposure: float) -> float:
        """Mean length in pixels of the points' paths in the image during ``exposure`` seconds."""
        return float(self._lengths(exposure).mean())

    def skew(self, readout: float) -> float:
        """Mean distance in pixels between the points as the first and as the last row's pose sees them."""
        return float(self._skews(readout).mean())

    def shutter(self, exposure: float, readout: float) -> Shutter:
        """The poses of the path that an exposure and a readout (seconds, of all rows) sample.

        Every row integrates its own exposure; the middle row's is centred on ``time``.
        """
        height = self.lens.height
        blur = float(np.quantile(self._lengths(exposure), FASTEST)) if exposure > 0 else 0.0
        samples = max(MIN_SAMPLES, math.ceil(blur))
        tick, stride = exposure / samples, int(exposure > 0)
        row = np.zeros(height, np.intp)
        if readout > 0:
            skew = float(np.quantile(self._skews(readout), FASTEST))
            row_step = readout / max(1, math.ceil(skew / ROW_STEP))
            stride = math.ceil(tick / row_step)
            tick = tick / stride if stride else row_step
            row = np.rint(readout / tick * ((np.arange(height) + 0.5) / height - 0.5)).astype(np.intp)
        index = row[None] + stride * np.arange(samples)[:, None]
        ticks, place = np.unique(index, return_inverse=True)
        times = self.time + (ticks - stride * (samples - 1) / 2) * tick
        return Shutter(self.path.poses(times), place.reshape(index.shape), times)

    def _lengths(self, exposure: float) -> ArrayF64:
        times = self.time + exposure * np.linspace(-0.5, 0.5, INSTANTS)
        return np.asarray(np.linalg.norm(np.diff(self._tracks(times), axis=0), axis=2).sum(0))

    def _skews(self, readout: float) -> ArrayF64:
        first, last = self._tracks(self.time + readout * np.array([-0.5, 0.5]))
        return np.asarray(np.linalg.norm(last - first, axis=1))

    def _tracks(self, times: ArrayF64) -> ArrayF64:
        """Image positions [T, P, 2] in pixels."""
        poses = self.path.poses(times)
        local = np.einsum("tpk,tkj->tpj", self.points - poses[:, None, :, 3], poses[:, :, :3])
        focal = np.array([self.lens.fx, self.lens.fy])
        return np.asarray(focal * local[..., :2] / np.maximum(local[..., 2:], 1e-6), np.float64)


def follow(path: HandheldPath, time: float, depth: ArrayF64, lens: Lens) -> SimulatedMotion:
    """The motion about a frame whose view at ``time`` has ``depth`` [H, W] (0 where there is nothing)."""
    columns = (np.arange(GRID[0]) + 0.5) / GRID[0] * lens.width
    rows = (np.arange(GRID[1]) + 0.5) / GRID[1] * lens.height
    x, y = np.meshgrid(columns, rows)
    z = depth[y.astype(int), x.astype(int)]
    rays = np.stack([(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, np.ones_like(x)], -1)
    seen = z > 0
    pose = path.poses(np.array([time]))[0]
    return SimulatedMotion(path, time, (rays * z[..., None])[seen] @ pose[:, :3].T + pose[:, 3], lens)


def duration_for(pixels: float, motion: Callable[[float], float]) -> float:
    """The duration in seconds over which ``motion(duration)``, rising, comes to ``pixels``; 0 for none.

    Raises InputError when a minute does not suffice.
    """
    if pixels <= 0:
        return 0.0
    longest = 1 / 64
    while motion(longest) < pixels:
        longest *= 2
        if longest > 60:
            raise InputError(
                "the camera hardly moves: its frames cannot be blurred",
                hint="choose the protocol sharp, or cameras that move",
            )
    return float(brentq(lambda duration: motion(duration) - pixels, 0.0, longest, xtol=1e-7))
