"""What is wrong with each frame of a synthetic capture, by protocol name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cleargs.errors import InputError
from cleargs.random_streams import Stream
from cleargs.synth import phone
from cleargs.synth.image_motion import SimulatedMotion, duration_for
from cleargs.synth.path import FPS
from cleargs.synth.phone import auto_exposure

REFERENCE_WIDTH = 640
"""Lengths in pixels are stated at this image width."""
NOISE = 1.0 / 255
"""Deviation of the sensor noise at mid grey of a well exposed frame, sRGB units."""
SHARP_BLUR = 0.8
"""Longest mean blur of a frame of `mixed` that counts as sharp, pixels."""


@dataclass(frozen=True)
class Protocol:
    """One way to spoil a capture. Lengths in pixels at `REFERENCE_WIDTH`.

    One exposure and one readout time serve the whole capture, chosen so that the means over its frames are
    as stated; how they vary from frame to frame is the walk's doing. ``shutter`` states the exposure itself.
    """

    blur: float = 0.0
    """Mean over the frames of the mean length of the motion path in the image; 0 for instants."""
    shutter: float = 0.0
    """Share of the time from frame to frame that the shutter is open for a row, in place of ``blur``."""
    skew: float = 0.0
    """Mean over the frames of the mean displacement between first and last row's pose; 0: global shutter."""
    rotation_noise: float = 0.0
    """Deviation about each axis of the given poses' rotation error, degrees."""
    translation_noise: float = 0.0
    """Deviation along each axis of the given poses' centre error, as a share of the capture's mean depth."""
    focal_error: float = 0.0
    """Error of the given focal length, as a share of the true one."""
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1 and p2 of the lens (OpenCV's model), of which the input says nothing."""
    mixed: bool = False
    """Faults by frame instead: see `_mixed`."""
    jpeg: int | None = None
    """JPEG quality; None for lossless PNG."""
    stretched: bool = False
    """Whether the hand shakes for stretches in one piece: see `cleargs.synth.path`."""
    phone: bool = False
    """Whether a phone processes the frames and something moves in the room: see `cleargs.synth.phone`."""


PROTOCOLS: dict[str, Protocol] = {
    "sharp": Protocol(),  # no fault but a little noise: the control that nothing may harm
    "mixed": Protocol(mixed=True, jpeg=92),
    "gs2e-slight": Protocol(blur=6),
    "gs2e-medium": Protocol(blur=12),
    "gs2e-severe": Protocol(blur=20),
    "gs2e-stretches": Protocol(blur=14, stretched=True),
    "gsotm-mb": Protocol(blur=8),
    "gsotm-rs": Protocol(skew=12),
    "gsotm-mb-rs": Protocol(blur=8, skew=12),
    "gsotm-pn": Protocol(rotation_noise=0.4, translation_noise=0.005),
    # A depth sensor's camera and poses: 7-Scenes' focal length is 13 % off, its poses miss by 1.7 px.
    "camera": Protocol(
        rotation_noise=0.4,
        translation_noise=0.005,
        focal_error=0.06,
        distortion=(0.08, -0.03, 0.001, -0.001),
    ),
    # Every fifth frame of a video of 30 a second whose shutter is open for 5/6 of the time.
    "phone": Protocol(shutter=1 / 6, skew=4, stretched=True, phone=True),
}


def find_protocol(name: str) -> Protocol:
    """The protocol called ``name``. Raises InputError where there is none."""
    if name not in PROTOCOLS:
        raise InputError(f"no protocol is called {name!r}", hint=f"choose one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[name]


@dataclass(frozen=True)
class Fault:
    """What is wrong with one frame."""

    exposure: float = 0.0
    """Seconds that the shutter is open for a row."""
    readout: float = 0.0
    """Seconds from the first row's exposure to the last one's."""
    defocus: float = 0.0
    """Mean radius of the blur disc, pixels of the image."""
    stops: float = 0.0
    """Exposure error."""
    noise: float = NOISE
    """Deviation of the sensor noise at mid grey, sRGB units."""


def plan(
    protocol: Protocol, motions: Sequence[SimulatedMotion], luminances: Sequence[float], seed: int
) -> list[Fault]:
    """The fault of each frame of a walk; ``luminances`` is what each frame's meter sees, in linear light."""
    scale = motions[0].lens.width / REFERENCE_WIDTH
    if protocol.mixed:
        return _mixed(motions, scale, np.random.default_rng([seed, Stream.MIXED_FAULTS]))
    exposure = protocol.shutter / FPS or duration_for(
        protocol.blur * scale, lambda time: float(np.mean([motion.blur(time) for motion in motions]))
    )
    readout = duration_for(
        protocol.skew * scale, lambda time: float(np.mean([motion.skew(time) for motion in motions]))
    )
    if not protocol.phone:
        return [Fault(exposure, readout)] * len(motions)
    gains = auto_exposure(np.array(luminances), 1 / FPS)
    return [Fault(exposure, readout, stops=float(stops), noise=phone.NOISE) for stops in gains]


def _mixed(motions: Sequence[SimulatedMotion], scale: float, rng: np.random.Generator) -> list[Fault]:
    """What phones give: of any two neighbours one is sharp (blur under `SHARP_BLUR`) and one is not.

    Of the others the 60 % that move fastest are blurred by 7-22 px; of the rest every other one is defocused
    by a disc of 3-6 px and misexposed by 1.3-2.2 stops in turn. The exposure of all drifts slowly by up to
    0.1 stops, as automatic exposure does.
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
        exposure = duration_for(blur * scale, motion.blur)
        faults.append(Fault(exposure, 0.0, radius * scale, stops, noise))
    return faults


def noisy_poses(
    poses: NDArray[np.float64],  # [F, 3, 4] camera to world
    protocol: Protocol,
    depth: float,
    seed: int,
) -> NDArray[np.float64]:  # [F, 3, 4]
    """The poses that the user is given, ``depth`` being the mean depth of the capture in world units."""
    rng = np.random.default_rng([seed, Stream.POSE_NOISE])
    turns = np.radians(protocol.rotation_noise) * rng.standard_normal((len(poses), 3))
    shifts = protocol.translation_noise * depth * rng.standard_normal((len(poses), 3))
    rotations = poses[:, :, :3] @ Rotation.from_rotvec(turns).as_matrix()
    return np.concatenate([rotations, poses[:, :, 3:] + shifts[..., None]], 2)
