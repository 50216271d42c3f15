"""Writes a synthetic capture: degraded frames and poses for the user, sharp truth beside them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa

from cleargs.errors import InputError
from cleargs.files import write_json
from cleargs.media.encode import require_even, write_video
from cleargs.parquet import write_table
from cleargs.progress import Reporter
from cleargs.random_streams import Stream
from cleargs.synth.develop import FRAMES, develop, write_depth, write_image, write_transforms
from cleargs.synth.image_motion import FrameMotion, follow
from cleargs.synth.optics import PINHOLE, Aperture, Array, Lens, Shutter, World, disc, phone_lens, still
from cleargs.synth.path import FPS, Course, frame_times, make_path, orbit
from cleargs.synth.phone import BITS_PER_PIXEL, PLAIN, Look, coded, metered, phone_look
from cleargs.synth.protocols import REFERENCE_WIDTH, Fault, Protocol, find_protocol, noisy_poses, plan

Film: TypeAlias = Callable[[Shutter, Lens, Aperture], tuple[Array, Array]]

NEAR_FOCUS = 0.2
"""Where a frame out of focus is focused, as a share of the mean distance: in front of everything."""


@dataclass(frozen=True)
class Setting:
    """Where a capture is made."""

    name: str
    world: World
    course: Course
    lens: Lens
    film: Film | None = None
    """The world with something that moves in it: light, and the share of the exposure in which a pixel sees
    it. A trained scene has none."""


def room_setting(frames: int, width: int, height: int, seed: int) -> Setting:
    """The procedural room of ``seed``, in metres, and a walk around its table."""
    from cleargs.synth.raycast import RoomWorld
    from cleargs.synth.room import make_balloon, make_room

    room = make_room(seed)
    world, course, lens = RoomWorld(room), orbit(room.focus, frames, seed), phone_lens(width, height)
    return Setting("room", world, course, lens, partial(world.film, make_balloon(room, seed)))


def scene_setting(scene: Path, cameras: Path | None, frames: int, width: int, height: int) -> Setting:
    """A trained scene, in its own units, and a walk along its real cameras. Raises InputError."""
    from cleargs.synth.splat_world import open_scene

    world, course, lens, name = open_scene(scene, cameras, frames, width, height)
    return Setting(name, world, course, lens)


def make_capture(
    out: Path,
    protocol: str,
    *,
    frames: int,
    width: int,
    height: int,
    seed: int,
    reporter: Reporter,
    scene: Path | None = None,
    cameras: Path | None = None,
    video: bool = False,
) -> dict[str, Any]:
    """Write the capture ``protocol`` into the new folder ``out``; returns what ``truth/capture.json`` says.

    The world is the room of ``seed``, or the Gaussian scene in ``scene``, walked along its real cameras (see
    `cleargs.synth.splat_world.open_scene`). ``out/images`` and ``out/transforms.json`` (and with ``video``
    ``out/capture.mp4``) are what a user would have. ``out/truth/observed`` and ``out/truth/novel`` hold sharp
    views in the same form, 8-bit sRGB PNGs, with exact poses: at the middle of the frames' exposures, with
    ``depth/``, and off the path. ``out/truth/frames.parquet`` (`cleargs.synth.develop.FRAMES`) has the faults
    of each frame.

    Where something moves, the truth is without it, and ``out/truth/moving`` has a mask for each frame: white
    where a pixel saw it at any time of the exposure (its shadow is not in the mask).

    Raises InputError for an unknown protocol, a folder that already holds something, a size that the video
    cannot have, or a scene or cameras that cannot be used.
    """
    rules = find_protocol(protocol)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is not empty", hint="name a new folder for the capture")
    if video or rules.phone:
        require_even(width, height)
    if scene is None:
        setting = room_setting(frames, width, height, seed)
    else:
        setting = scene_setting(scene, cameras, frames, width, height)
    look = phone_look(seed) if rules.phone else PLAIN
    film = setting.film if rules.phone else None
    path, times = make_path(setting.course, frames, seed, stretched=rules.stretched), frame_times(frames)
    poses = path.poses(times)
    novel = _novel_poses(setting.course, max(4, frames // 4), seed)
    stems = [f"{number:06d}" for number in range(frames)]
    (out / "images").mkdir(parents=True, exist_ok=True)
    with reporter.task(f"synth {protocol}", 2 * frames + len(novel)) as task:
        motions, depths, luminances = [], [], []
        for folder in ("observed/images", "observed/depth", "novel/images"):
            (out / "truth" / folder).mkdir(parents=True)
        for stem, time, pose in zip(stems, times, poses, strict=True):
            depth = setting.world.depth(pose, setting.lens)
            write_depth(out / "truth" / "observed" / "depth" / f"{stem}.exr", depth)
            light = _write_sharp(out / "truth" / "observed", stem, setting, pose, look)
            luminances.append(metered(light))
            motions.append(follow(path, float(time), depth, setting.lens))
            depths.append(_Depths.of(depth))
            task.advance()
        faults = plan(rules, motions, luminances, seed)
        images = [f"images/{stem}.{'png' if rules.jpeg is None else 'jpg'}" for stem in stems]
        shots, seen_shares = [], []
        if film is not None:
            (out / "truth" / "moving").mkdir()
        for number, (motion, fault, depth_means) in enumerate(zip(motions, faults, depths, strict=True)):
            rng = np.random.default_rng([seed, Stream.EXPOSURES, number])
            light, seen = _expose(setting, film, motion, fault, depth_means, rng)
            shots.append(develop(light, stops=fault.stops, noise=fault.noise, rng=rng, look=look))
            seen_shares.append(float((seen > 0).mean()))
            if film is not None:
                mask = np.repeat(np.where(seen > 0, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)
                write_image(out / "truth" / "moving" / f"{stems[number]}.png", mask)
            task.advance()
        if rules.phone:
            shots = coded(out / "capture.mp4", shots, FPS)
        for image, shot in zip(images, shots, strict=True):
            write_image(out / image, shot, rules.jpeg)
        novel_stems = [f"{number:06d}" for number in range(len(novel))]
        for stem, pose in zip(novel_stems, novel, strict=True):
            _write_sharp(out / "truth" / "novel", stem, setting, pose, look)
            task.advance()
    if video and not rules.phone:
        write_video(out / "capture.mp4", shots, FPS)
    rows = [
        _row(number, image, motion, fault) | {"moving_share": share}
        for number, (image, motion, fault, share) in enumerate(
            zip(images, motions, faults, seen_shares, strict=True)
        )
    ]
    formation = {
        "tone_contrast": look.contrast,
        "tone_pivot": look.pivot,
        "sharpening": look.sharpening,
        "codec_bits_per_pixel": BITS_PER_PIXEL if rules.phone else 0.0,
    }
    rows = [row | formation for row in rows]
    write_table(out / "truth" / "frames.parquet", pa.Table.from_pylist(rows), FRAMES)
    sharp = [f"images/{stem}.png" for stem in stems]
    write_transforms(out / "truth" / "observed", setting.lens, sharp, poses)
    write_transforms(out / "truth" / "novel", setting.lens, [f"images/{s}.png" for s in novel_stems], novel)
    mean_depth = float(np.mean([depth.mean for depth in depths]))
    given = noisy_poses(poses, rules, mean_depth, seed)
    summary = {
        "protocol": protocol,
        "seed": seed,
        "world": setting.name,
        "frames": frames,
        "width": width,
        "height": height,
        "fps": FPS,
        "jpeg_quality": rules.jpeg,
        "codec_bits_per_pixel": formation["codec_bits_per_pixel"],
        "moving": film is not None,
        "blur_px": _distribution([row["blur_px"] for row in rows]),
        "rolling_shutter_px": _distribution([row["rolling_shutter_px"] for row in rows]),
        "px_at_640": REFERENCE_WIDTH / width,
        "mean_depth": mean_depth,
        "pose_noise": _pose_noise(rules, mean_depth),
    }
    write_json(out / "truth" / "capture.json", summary)
    write_transforms(out, setting.lens, images, given)
    return summary


@dataclass(frozen=True)
class _Depths:
    """Of the pixels that see something."""

    mean: float
    nearness: float
    """Mean of 1 / depth."""

    @staticmethod
    def of(depth: Array) -> _Depths:
        seen = depth[depth > 0]
        return _Depths(float(seen.mean()), float((1 / seen).mean())) if seen.size else _Depths(1.0, 1.0)


def _expose(
    setting: Setting,
    film: Film | None,
    motion: FrameMotion,
    fault: Fault,
    depths: _Depths,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """One frame as it falls on the sensor, in linear light, and the share [H, W] that sees what moves."""
    shutter, aperture = motion.shutter(fault.exposure, fault.readout), PINHOLE
    if fault.defocus > 0:
        # The mean radius of a uniform disc's points is 2/3 of its rim, and `defocus` states the mean.
        focus = NEAR_FOCUS / depths.nearness
        radius = 1.5 * fault.defocus / (setting.lens.fx * (1 / focus - depths.nearness))
        # A disc of that many points has neighbours about a pixel apart.
        shutter = _repeated(shutter, math.ceil(4 * fault.defocus**2))
        aperture = Aperture(disc(shutter.samples, radius)[rng.permutation(shutter.samples)], focus)
    if film is not None:
        return film(shutter, setting.lens, aperture)
    light = setting.world.render(shutter, setting.lens, aperture)
    return light, np.zeros(light.shape[:2])


def _repeated(shutter: Shutter, samples: int) -> Shutter:
    """The shutter with at least so many samples, the same at each instant."""
    index = np.tile(shutter.index, (math.ceil(samples / shutter.samples), 1))
    return Shutter(shutter.poses, index, shutter.times)


def _write_sharp(folder: Path, stem: str, setting: Setting, pose: Array, look: Look) -> Array:
    """Writes the sharp view and returns its light [H, W, 3]."""
    light = setting.world.render(still(pose, setting.lens.height), setting.lens)
    write_image(folder / "images" / f"{stem}.png", develop(light, look=look))
    return light


def _novel_poses(course: Course, count: int, seed: int) -> Array:
    rng = np.random.default_rng([seed, Stream.NOVEL_POSES])
    return np.stack([course.novel((number + 0.5) / count, rng) for number in range(count)])


def _row(number: int, image: str, motion: FrameMotion, fault: Fault) -> dict[str, Any]:
    return {
        "frame_id": number,
        "image": image,
        "time_s": motion.time,
        "blur_px": motion.blur(fault.exposure),
        "defocus_px": fault.defocus,
        "exposure_ev": fault.stops,
        "noise": fault.noise,
        "rolling_shutter_px": motion.skew(fault.readout),
        "exposure_s": fault.exposure,
        "shutter_share": fault.exposure * FPS,
        "readout_s": fault.readout,
    }


def _distribution(values: list[float]) -> dict[str, Any]:
    low, middle, high = (float(value) for value in np.quantile(values, [0.25, 0.5, 0.75]))
    return {"mean": float(np.mean(values)), "quartiles": [low, middle, high], "max": max(values)}


def _pose_noise(protocol: Protocol, depth: float) -> dict[str, float] | None:
    """Deviations about and along each axis; None for exact poses."""
    if not protocol.rotation_noise and not protocol.translation_noise:
        return None
    return {
        "rotation_deg": protocol.rotation_noise,
        "translation": protocol.translation_noise * depth,
    }
