"""Protocols of synthetic captures: the degradation of each frame, by protocol name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cleargs.random_streams import Stream
from cleargs.synth import phone
from cleargs.synth.image_motion import SimulatedMotion, solve_duration
from cleargs.synth.path import FPS
from cleargs.synth.phone import auto_exposure
from cleargs.types import ArrayF64

REFERENCE_WIDTH = 640
"""Image width, px, for which lengths in pixels are stated."""
NOISE = 1.0 / 255
"""Standard deviation of the sensor noise at mid grey in a well exposed frame, sRGB units."""
SHARP_BLUR = 0.8
"""Maximum blur of a sharp frame of `mixed`, pixels at `REFERENCE_WIDTH`."""


@dataclass(frozen=True)
class Protocol:
    """Degradation of a capture. Lengths are in pixels at `REFERENCE_WIDTH`.

    Exposure and readout time are constant within a capture. They are chosen so that the means over the frames
    are ``blur`` and ``skew``. Both vary between frames with the speed of the walk.
    """

    blur: float = 0.0
    """Mean length of the motion path in the image, over points and frames; 0: no motion blur."""
    shutter: float = 0.0
    """Exposure time as a share of 1 / `FPS` seconds; replaces ``blur``."""
    skew: float = 0.0
    """Mean displacement between first and last row's poses, over points and frames; 0: global shutter."""
    rotation_noise: float = 0.0
    """Standard deviation per axis of the rotation error of the given poses, degrees."""
    translation_noise: float = 0.0
    """Standard deviation per axis of the error of the given camera centres, as a share of the mean depth."""
    focal_error: float = 0.0
    """Error of the given focal length, as a share of the true one."""
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1 and p2 of the lens (OpenCV's model); they are not in the input."""
    mixed: bool = False
    """Choose a fault for each frame instead: see `_mixed`."""
    jpeg: int | None = None
    """JPEG quality; None for lossless PNG."""
    stretched: bool = False
    """The hand shakes in stretches of consecutive frames: see `cleargs.synth.path`."""
    shots: bool = False
    """Single photographs with long exposures, during which the hand trembles: see `path.StillHand`."""
    phone: bool = False
    """A phone processes the frames, and a balloon moves in the room: see `cleargs.synth.phone`."""
    moving: int = 0
    """With ``phone``: instead of the balloon, a household of this severity; see `cleargs.synth.movers`."""


PROTOCOLS: dict[str, Protocol] = {
    "sharp": Protocol(),  # the control: only slight noise
    "mixed": Protocol(mixed=True, jpeg=92),
    "gs2e-slight": Protocol(blur=6),
    "gs2e-medium": Protocol(blur=12),
    "gs2e-severe": Protocol(blur=20),
    "gs2e-stretches": Protocol(blur=14, stretched=True),
    "tremor": Protocol(blur=12, shots=True),  # lengths as in gs2e-medium, but bent paths
    "gsotm-mb": Protocol(blur=8),
    "gsotm-rs": Protocol(skew=12),
    "gsotm-mb-rs": Protocol(blur=8, skew=12),
    "gsotm-pn": Protocol(rotation_noise=0.4, translation_noise=0.005),
    # As with a depth sensor: the focal length of 7-Scenes is 13 % off, and its poses miss by 1.7 px.
    "camera": Protocol(
        rotation_noise=0.4, translation_noise=0.005, focal_error=0.06, distortion=(0.08, -0.03, 0.001, -0.001)
    ),
    # Every fifth frame of a video with 30 frames per second and a shutter that is open 5/6 of the time.
    "phone": Protocol(shutter=1 / 6, skew=4, stretched=True, phone=True),
    "moving": Protocol(shutter=1 / 6, skew=4, stretched=True, phone=True, moving=1),
    "moving-severe": Protocol(shutter=1 / 6, skew=4, stretched=True, phone=True, moving=2),
}


@dataclass(frozen=True)
class Fault:
    """Degradation of one frame."""

    exposure: float = 0.0
    """Exposure time of a row, seconds."""
    readout: float = 0.0
    """Time from the first row's exposure to the last one's, seconds."""
    defocus: float = 0.0
    """Mean radius of the blur disc, pixels of the image."""
    stops: float = 0.0
    """Exposure error, stops."""
    noise: float = NOISE
    """Standard deviation of the sensor noise at mid grey, sRGB units."""


def plan_faults(
    protocol: Protocol,
    motions: Sequence[SimulatedMotion],
    luminances: Sequence[float],  # `cleargs.synth.phone.metered_luminance`, for automatic exposure
    rate: float,  # frames per second
    seed: int,
) -> list[Fault]:
    """Choose the fault of each frame of a walk."""
    scale = motions[0].lens.width / REFERENCE_WIDTH
    if protocol.mixed:
        return _mixed(motions, scale, np.random.default_rng([seed, Stream.MIXED_FAULTS]))
    exposure = protocol.shutter / FPS or solve_duration(
        protocol.blur * scale, lambda time: float(np.mean([motion.blur(time) for motion in motions]))
    )
    readout = solve_duration(
        protocol.skew * scale, lambda time: float(np.mean([motion.skew(time) for motion in motions]))
    )
    if not protocol.phone:
        return [Fault(exposure, readout)] * len(motions)
    gains = auto_exposure(np.array(luminances), 1 / rate)
    return [Fault(exposure, readout, stops=float(stops), noise=phone.NOISE) for stops in gains]


def _mixed(motions: Sequence[SimulatedMotion], scale: float, rng: np.random.Generator) -> list[Fault]:
    """Choose mixed faults: one frame of each pair is sharp (blur up to `SHARP_BLUR`), the other is degraded.

    The 60 % of the degraded frames that move fastest get a motion blur of 7-22 px. The rest is defocused by a
    disc of 3-6 px or misexposed by 1.3-2.2 stops, in turn. The exposure of all frames drifts slowly by up to
    0.1 stops, as with automatic exposure.
    """
    count = len(motions)
    pairs = np.arange(0, count - 1, 2)
    degraded = [int(number) for number in pairs + rng.integers(0, 2, len(pairs))]
    by_speed = sorted(degraded, key=lambda number: -motions[number].blur(0.02))
    blurred = by_speed[: round(0.6 * len(by_speed))]
    defocused = sorted(by_speed[len(blurred) :])[::2]
    drift = 0.1 * np.sin(2 * np.pi * (np.arange(count) / 24 + rng.uniform()))
    faults = []
    for number, motion in enumerate(motions):
        blur, radius, stops = rng.uniform(0.1, SHARP_BLUR), 0.0, float(drift[number])
        noise = NOISE
        if number in blurred:
            blur, noise = rng.uniform(7, 22), 2 * NOISE
        elif number in defocused:
            radius = rng.uniform(3, 6)
        elif number in degraded:
            stops += float(rng.choice([-1, 1]) * rng.uniform(1.3, 2.2))
            noise = 3 * NOISE
        exposure = solve_duration(blur * scale, motion.blur)
        faults.append(Fault(exposure, 0.0, radius * scale, stops, noise))
    return faults


def noisy_poses(
    poses: ArrayF64,  # [F, 3, 4] camera to world
    protocol: Protocol,
    depth: float,
    seed: int,
) -> ArrayF64:  # [F, 3, 4]
    """Return the given poses: ``poses`` with the noise of ``protocol`` at this mean depth, world units."""
    rng = np.random.default_rng([seed, Stream.POSE_NOISE])
    turns = np.radians(protocol.rotation_noise) * rng.standard_normal((len(poses), 3))
    shifts = protocol.translation_noise * depth * rng.standard_normal((len(poses), 3))
    rotations = poses[:, :, :3] @ Rotation.from_rotvec(turns).as_matrix()
    return np.concatenate([rotations, poses[:, :, 3:] + shifts[..., None]], 2)
