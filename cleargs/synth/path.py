"""A handheld walk: a smooth course at an uneven pace, with tremor and swings of the hand.

The path is continuous in time and also gives the poses within an exposure. Its speed determines blur and
rolling-shutter skew, so that frame quality varies along it. Poses are camera to world with OpenCV axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from cleargs.random_streams import Stream
from cleargs.synth.optics import Aperture, Lens, Shutter, World
from cleargs.types import ArrayF64

UP = np.array([0.0, 1.0, 0.0])
"""The up axis of the world."""
DEGREES_PER_FRAME, MAX_DEGREES = 4.0, 150.0
"""Angle of an orbit per frame, and its maximum."""


class Course(Protocol):
    """The smooth course of a walk, without pauses or tremor."""

    def poses(self, shares: ArrayF64) -> ArrayF64:
        """Return poses [T, 3, 4] at ``shares`` [T] of the course, from 0 to 1 or slightly outside."""

    def novel(self, share: float, rng: np.random.Generator) -> ArrayF64:
        """Return a random pose [3, 4] off the course, near ``share``, with about the same target."""


@dataclass(frozen=True)
class SceneSetup:
    """World, course and lens of a capture."""

    name: str
    world: World
    course: Course
    lens: Lens
    film: Callable[[Shutter, Lens, Aperture], tuple[ArrayF64, ArrayF64]] | None = None
    """Renders the world with a moving object. Returns linear light [H, W, 3], and per pixel [H, W] the share
    of the exposure that sees the object. None: no such object."""


def look_at(centres: ArrayF64, target: ArrayF64) -> ArrayF64:  # [..., 3], [3]
    """Return level poses [..., 3, 4] at ``centres`` that look at ``target``, in a world with y up."""
    forward = target - centres
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward, centres], -1)


class Orbit:
    """An arc around ``focus`` at varying height and distance, in metres.

    Frames are about `DEGREES_PER_FRAME` apart. The arc covers at most `MAX_DEGREES`.
    """

    def __init__(self, focus: ArrayF64, frames: int, seed: int) -> None:
        self._focus = focus
        self._arc = float(np.radians(min(DEGREES_PER_FRAME * frames, MAX_DEGREES)))
        rng = np.random.default_rng([seed, Stream.ORBIT])
        self._phases = rng.uniform(0, 2 * np.pi, 2)  # phases of distance and height, radians

    def poses(self, shares: ArrayF64) -> ArrayF64:
        return look_at(self._centres(shares), self._focus)

    def novel(self, share: float, rng: np.random.Generator) -> ArrayF64:
        """Return a pose up to 0.22 m per axis off the course, about 1.5 times the step between frames."""
        centre = self._centres(np.array([share]))[0] + rng.uniform(-0.22, 0.22, 3)
        return look_at(centre, self._focus + rng.uniform(-0.08, 0.08, 3))

    def _centres(self, shares: ArrayF64) -> ArrayF64:
        angle = (shares - 0.5) * self._arc
        distance = 2.15 + 0.2 * np.sin(2 * np.pi * shares + self._phases[0])
        height = 1.4 + 0.18 * np.sin(4 * np.pi * shares + self._phases[1])
        east, south = self._focus[0] + distance * np.sin(angle), self._focus[2] + distance * np.cos(angle)
        return np.stack([east, height, south], 1)


FPS = 6.0
"""Frames per second, for a walk of a few degrees per frame."""
FRAMES_PER_PAUSE = 6.0
"""Mean number of frames between slow parts of the walk."""
PACE_AMPLITUDE = 0.8
"""The pace is between 1 - PACE_AMPLITUDE and 1 + PACE_AMPLITUDE times its mean."""
TREMOR_HZ = (1.0, 12.0)
TREMOR_RADIANS = 0.005
"""Standard deviation of the tremor, about a third of a degree, as of a walking person with a steady hand."""
FRAMES_PER_SWING = 4.0
SWING_SECONDS = 0.12
SWING_RADIANS = (0.035, 0.085)
FRAMES_PER_STRETCH = 32
"""A stretched walk has one shaky stretch per this many frames."""
STRETCH_SHARE = 0.375
"""Share of these frames in the stretch."""
SHAKE_GAIN = 12.0
"""Factor of the tremor within a stretch, as of a hand in a hurry. A stretched walk has swings only there."""
STRETCH_EDGE_S = 1 / FPS
"""Seconds over which the shaking rises and falls."""
SHOT_SECONDS = 1.0
"""Time between two photographs. The walk nearly stops for each."""
SHOT_BANDS = (((0.3, 2.0), 6), ((4.0, 12.0), 8))
"""Range in Hz and number of waves of the slow drift and of the tremor of a hand that holds a camera still."""
SHOT_SPEED = 0.05
"""Standard deviation of the speed of the drift, and of the tremor, about each axis, radians per second."""
SURGE_HZ, SURGE_AMPLITUDE = 1.5, 0.8
"""The tremor swells and fades at about this rate, between 1 - SURGE_AMPLITUDE and 1 + SURGE_AMPLITUDE."""


class Hand:
    """Rotation of the camera by the hand.

    The tremor has the same speed in each band from 1 to 12 Hz, and the hand swings every few frames. If
    ``stretched``, it shakes strongly in stretches of consecutive frames. Tremor of the position is left out:
    rotation moves the image much more, except for surfaces less than a step away.
    """

    def __init__(self, duration: float, seed: int, *, stretched: bool = False) -> None:
        rng = np.random.default_rng([seed, Stream.HAND])
        self._frequencies = np.geomspace(*TREMOR_HZ, 12)[:, None] * rng.uniform(0.92, 1.0, (12, 3))  # Hz
        amplitudes = 1 / self._frequencies
        amplitudes *= TREMOR_RADIANS * np.sqrt(2 / np.square(amplitudes).sum(0))
        self._amplitudes = amplitudes  # [harmonics, 3] radians
        count = max(1, round(duration * FPS / FRAMES_PER_SWING))
        self._swing_times = (np.arange(count) + rng.uniform(0, 1, count)) / count * duration  # seconds
        direction = rng.uniform(0, 2 * np.pi, count)
        axes = np.stack([np.cos(direction), np.sin(direction), rng.normal(0, 0.2, count)], 1)
        self._swing_turns = rng.uniform(*SWING_RADIANS, (count, 1)) * axes  # [swings, 3] radians
        self._phases = rng.uniform(0, 2 * np.pi, (12, 3))
        count = max(1, round(duration * FPS / FRAMES_PER_STRETCH)) if stretched else 0
        free = np.random.default_rng([seed, Stream.SHAKY_STRETCHES]).uniform(0, 1 - STRETCH_SHARE, count)
        starts = np.arange(count) + free
        self.stretches = np.stack([starts, starts + STRETCH_SHARE], 1) * duration / max(count, 1)
        """Begin and end [stretches, 2] of each stretch, seconds."""

    def turns(self, times: ArrayF64) -> ArrayF64:  # [T]
        """Return rotation vectors [T, 3] about the camera's axes, radians."""
        waves = np.sin(2 * np.pi * self._frequencies * times[:, None, None] + self._phases)
        tremor = (self._amplitudes * waves).sum(1)
        # A swing goes to one side, back through the middle at full speed, to the other side, and back. It is
        # 1 at the extremes.
        share = (times[:, None] - self._swing_times) / SWING_SECONDS
        swings = share * np.exp((1 - share**2) / 2)
        if len(self.stretches):
            strength = self.shake_strength(times)[:, None]
            tremor, swings = tremor * (1 + (SHAKE_GAIN - 1) * strength), swings * strength
        return np.asarray(tremor + swings @ self._swing_turns, np.float64)

    def shake_strength(self, times: ArrayF64) -> ArrayF64:  # [T] seconds
        """Return the strength of the shaking [T]: 1 within a stretch, 0 outside."""
        start, end = self.stretches.T
        inside = np.minimum(times[:, None] - start, end - times[:, None])
        share = np.clip(inside / STRETCH_EDGE_S + 0.5, 0, 1)
        return np.asarray((share**2 * (3 - 2 * share)).sum(1))


class StillHand:
    """Rotation of a camera that a hand tries to hold still, for photographs with long exposures.

    It is the sum of a drift below 2 Hz and the physiological tremor of 4 to 12 Hz, which swells and fades.
    These are the two parts of camera shake in Gavant et al., "A physiological camera shake model for image
    stabilization systems" (IEEE Sensors 2011). Within an exposure of a fifth of a second the path is bent,
    its speed is uneven, and it rests where the directions change.
    """

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, Stream.HAND])
        bands = [np.geomspace(*band, count)[:, None] for band, count in SHOT_BANDS]
        self._frequencies = [band * rng.uniform(0.92, 1.0, (len(band), 3)) for band in bands]  # Hz
        self._phases = [rng.uniform(0, 2 * np.pi, (len(band), 3)) for band in bands]
        self._surge = rng.uniform(0, 2 * np.pi)  # phase, radians

    def turns(self, times: ArrayF64) -> ArrayF64:  # [T]
        """Return rotation vectors [T, 3] about the camera's axes, radians."""
        drift, tremor = (
            (SHOT_SPEED * math.sqrt(2 / len(rates)) / (rates * 2 * np.pi))
            * np.sin(2 * np.pi * rates * times[:, None, None] + phases)
            for rates, phases in zip(self._frequencies, self._phases, strict=True)
        )
        surge = 1 + SURGE_AMPLITUDE * np.sin(2 * np.pi * SURGE_HZ * times + self._surge)
        return np.asarray(drift.sum(1) + surge[:, None] * tremor.sum(1), np.float64)


class HandheldPath:
    """Pose of the camera at any time of a walk along a course.

    The walk has ``frames`` frames at `FPS`. For ``stretched`` see `Hand`. With ``shots`` the camera stops for
    each of ``frames`` photographs, `SHOT_SECONDS` apart, in a `StillHand`.
    """

    def __init__(
        self, course: Course, frames: int, seed: int, *, stretched: bool = False, shots: bool = False
    ) -> None:
        self.duration = frames * SHOT_SECONDS if shots else frames / FPS
        """Duration in seconds."""
        self.hand = StillHand(seed) if shots else Hand(self.duration, seed, stretched=stretched)
        self._course = course
        self._pauses = frames if shots else max(1, round(frames / FRAMES_PER_PAUSE))
        rng = np.random.default_rng([seed, Stream.WALK])
        self._phase = 0.0 if shots else rng.uniform(0, 2 * np.pi)  # phase of the pace, radians

    def poses(self, times: ArrayF64) -> ArrayF64:  # [T] seconds
        """Return poses [T, 3, 4], camera to world with OpenCV axes."""
        poses = self._course.poses(self.progress(times))
        turns = Rotation.from_rotvec(self.hand.turns(times)).as_matrix()
        return np.concatenate([poses[:, :, :3] @ turns, poses[:, :, 3:]], 2)

    def progress(self, times: ArrayF64) -> ArrayF64:
        """Return the share of the course [T] at ``times``, with a speed of 1 + PACE_AMPLITUDE cos(phase)."""
        share, turn = times / self.duration, 2 * np.pi * self._pauses
        wave = np.sin(turn * share + self._phase) - np.sin(self._phase)
        return np.asarray(share + PACE_AMPLITUDE / turn * wave, np.float64)


def frame_times(frames: int, rate: float = FPS) -> ArrayF64:
    """Return the middles of the exposures [frames], in seconds, of ``rate`` frames per second."""
    return np.asarray((np.arange(frames) + 0.5) / rate, np.float64)
