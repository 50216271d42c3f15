"""A handheld walk: a smooth course, walked at an uneven pace by a hand that trembles and swings.

A course leads around the room's table from share 0 to share 1.
One path gives every pose, those within an exposure included: blur and skew are what its speed makes of the
exposure and the readout, and so frame quality varies along it. Poses are camera to world with OpenCV axes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from cleargs.random_streams import Stream
from cleargs.synth.optics import Aperture, Lens, Shutter, World
from cleargs.types import ArrayF64

UP = np.array([0.0, 1.0, 0.0])
DEGREES_PER_FRAME, MAX_DEGREES = 4.0, 150.0


class Course(Protocol):
    """The drift of a walk, without pauses or tremor."""

    def poses(self, shares: ArrayF64) -> ArrayF64:
        """Poses [T, 3, 4] at ``shares`` [T] of the way; a little beyond 0 and 1 is allowed."""

    def novel(self, share: float, rng: np.random.Generator) -> ArrayF64:
        """A pose [3, 4] off the course, near ``share``, that looks at what the course looks at."""


@dataclass(frozen=True)
class SceneSetup:
    """Where a capture is made."""

    name: str
    world: World
    course: Course
    lens: Lens
    film: Callable[[Shutter, Lens, Aperture], tuple[ArrayF64, ArrayF64]] | None = None
    """The world with something that moves in it: light, and the share of the exposure in which a pixel sees
    it."""


def look_at(centres: ArrayF64, target: ArrayF64) -> ArrayF64:  # [..., 3], [3]
    """Poses [..., 3, 4] at ``centres`` that look at ``target``, level in a world with y up."""
    forward = target - centres
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward, centres], -1)


class Orbit:
    """An arc around ``focus`` at changing height and distance, in metres.

    ``frames`` neighbours on it are about 4 degrees apart, over at most 150 degrees.
    """

    def __init__(self, focus: ArrayF64, frames: int, seed: int) -> None:
        self._focus = focus
        self._arc = float(np.radians(min(DEGREES_PER_FRAME * frames, MAX_DEGREES)))
        rng = np.random.default_rng([seed, Stream.ORBIT])
        self._phases = rng.uniform(0, 2 * np.pi, 2)  # of distance and height

    def poses(self, shares: ArrayF64) -> ArrayF64:
        return look_at(self._centres(shares), self._focus)

    def novel(self, share: float, rng: np.random.Generator) -> ArrayF64:
        """Nearer or farther, higher or lower: off by up to one and a half frames' way in each axis."""
        centre = self._centres(np.array([share]))[0] + rng.uniform(-0.22, 0.22, 3)
        return look_at(centre, self._focus + rng.uniform(-0.08, 0.08, 3))

    def _centres(self, shares: ArrayF64) -> ArrayF64:
        angle = (shares - 0.5) * self._arc
        distance = 2.15 + 0.2 * np.sin(2 * np.pi * shares + self._phases[0])
        height = 1.4 + 0.18 * np.sin(4 * np.pi * shares + self._phases[1])
        east, south = self._focus[0] + distance * np.sin(angle), self._focus[2] + distance * np.cos(angle)
        return np.stack([east, height, south], 1)


FPS = 6.0
"""Frames a second: what a walk of a few degrees a frame needs."""
FRAMES_PER_PAUSE = 6.0
PAUSE = 0.8
"""The pace lies between 1 - PAUSE and 1 + PAUSE of its mean."""
TREMOR_HZ = (1.0, 12.0)
TREMOR_RADIANS = 0.005
"""Deviation of the aim, about a third of a degree, as of a hand that walks and tries to hold still."""
FRAMES_PER_SWING = 4.0
SWING_SECONDS = 0.12
SWING_RADIANS = (0.035, 0.085)
FRAMES_PER_STRETCH = 32
STRETCH_SHARE = 0.375
"""Of every `FRAMES_PER_STRETCH` frames of a stretched walk this share, in one piece, is shaky."""
SHAKING = 12.0
"""How many times larger the tremor is there: as of a hand in a hurry. It swings only there."""
STRETCH_EDGE = 1 / FPS
"""Seconds over which the shaking comes and goes."""


class Hand:
    """Turns of the aim about the camera's axes. Tremor of position is left out: at more than a step's
    distance the turn moves the image far more.

    The tremor has the same speed in each band from 1 to 12 Hz, and the hand swings every few frames.
    ``stretched``: and it shakes for stretches in one piece, one in every `FRAMES_PER_STRETCH` frames.
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
        """Seconds [stretches, 2] from and to which the hand shakes."""

    def turns(self, times: ArrayF64) -> ArrayF64:  # [T]
        """Rotation vectors [T, 3]."""
        waves = np.sin(2 * np.pi * self._frequencies * times[:, None, None] + self._phases)
        tremor = (self._amplitudes * waves).sum(1)
        # Out to one side, through the middle at full speed, back from the other: 1 at the extremes.
        share = (times[:, None] - self._swing_times) / SWING_SECONDS
        swings = share * np.exp((1 - share**2) / 2)
        if len(self.stretches):
            strength = self.shake_strength(times)[:, None]
            tremor, swings = tremor * (1 + (SHAKING - 1) * strength), swings * strength
        return np.asarray(tremor + swings @ self._swing_turns, np.float64)

    def shake_strength(self, times: ArrayF64) -> ArrayF64:  # [T] seconds
        """1 [T] within a stretch, 0 outside."""
        start, end = self.stretches.T
        inside = np.minimum(times[:, None] - start, end - times[:, None])
        share = np.clip(inside / STRETCH_EDGE + 0.5, 0, 1)
        return np.asarray((share**2 * (3 - 2 * share)).sum(1))


class HandheldPath:
    """Where the camera is at any time of a walk along ``course`` that takes ``frames`` frames at `FPS`; for
    ``stretched`` see `Hand`.
    """

    def __init__(self, course: Course, frames: int, seed: int, *, stretched: bool = False) -> None:
        self.duration = frames / FPS
        """Seconds."""
        self.hand = Hand(self.duration, seed, stretched=stretched)
        self._course = course
        self._pauses = max(1, round(frames / FRAMES_PER_PAUSE))
        rng = np.random.default_rng([seed, Stream.WALK])
        self._phase = rng.uniform(0, 2 * np.pi)  # of the pace, radians

    def poses(self, times: ArrayF64) -> ArrayF64:  # [T] seconds
        """Camera to world [T, 3, 4] with OpenCV axes."""
        poses = self._course.poses(self.progress(times))
        turns = Rotation.from_rotvec(self.hand.turns(times)).as_matrix()
        return np.concatenate([poses[:, :, :3] @ turns, poses[:, :, 3:]], 2)

    def progress(self, times: ArrayF64) -> ArrayF64:
        """Share of the course walked: its speed is 1 + PAUSE cos, so that frames bunch at the pauses."""
        share, turn = times / self.duration, 2 * np.pi * self._pauses
        wave = np.sin(turn * share + self._phase) - np.sin(self._phase)
        return np.asarray(share + PAUSE / turn * wave, np.float64)


def frame_times(frames: int) -> ArrayF64:
    """Middles of the exposures, seconds [frames]."""
    return np.asarray((np.arange(frames) + 0.5) / FPS, np.float64)
