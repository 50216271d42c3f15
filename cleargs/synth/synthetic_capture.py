"""Writes a synthetic capture: degraded frames and poses for the user, sharp truth beside them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cleargs.errors import InputError
from cleargs.files import write_json
from cleargs.media.encode import require_even, write_video
from cleargs.media.exr import write_depth
from cleargs.media.image import write_rgb
from cleargs.parquet import write_table
from cleargs.progress import Reporter
from cleargs.random_streams import Stream
from cleargs.synth.develop import FRAMES, develop, write_transforms
from cleargs.synth.image_motion import FrameMotion, follow
from cleargs.synth.optics import PINHOLE, Aperture, Array, disc, still
from cleargs.synth.path import FPS, Setting, frame_times, make_path
from cleargs.synth.phone import BITS_PER_PIXEL, PLAIN, Look, coded, metered, phone_look
from cleargs.synth.protocols import REFERENCE_WIDTH, Fault, find_protocol, noisy_poses, plan
from cleargs.synth.raycast import room_setting

NEAR_FOCUS = 0.2
"""Where a frame out of focus is focused, as a share of the mean distance: in front of everything."""


def make_capture(
    out: Path,
    protocol: str,
    *,
    frames: int,
    width: int,
    height: int,
    seed: int,
    reporter: Reporter,
    setting: Setting | None = None,
    video: bool = False,
) -> dict[str, Any]:
    """Write the capture ``protocol`` into the new folder ``out``; returns what ``truth/capture.json`` says.

    It is made in the room of ``seed``, or in another ``setting`` of as many frames of that size.
    ``out/images`` and ``out/transforms.json`` (and with ``video`` ``out/capture.mp4``) are what a user would
    have. ``out/truth/observed`` and ``out/truth/novel`` hold sharp
    views in the same form, 8-bit sRGB PNGs, with exact poses: at the middle of the frames' exposures, with
    ``depth/``, and off the path. ``out/truth/frames.parquet`` (`cleargs.synth.develop.FRAMES`) has the faults
    of each frame.

    Where something moves, the truth is without it, and ``out/truth/moving`` has a mask for each frame: white
    where a pixel saw it at any time of the exposure (its shadow is not in the mask).

    Raises InputError for an unknown protocol, a folder that already holds something, or a size that the video
    cannot have.
    """
    rules = find_protocol(protocol)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is not empty", hint="name a new folder for the capture")
    if video or rules.phone:
        require_even(width, height)
    setting = setting or room_setting(frames, width, height, seed)
    look = phone_look(seed) if rules.phone else PLAIN
    formation = {
        "tone_contrast": look.contrast,
        "tone_pivot": look.pivot,
        "sharpening": look.sharpening,
        "codec_bits_per_pixel": BITS_PER_PIXEL if rules.phone else 0.0,
    }
    if not rules.phone:
        setting = replace(setting, film=None)
    path, times = make_path(setting.course, frames, seed, stretched=rules.stretched), frame_times(frames)
    poses = path.poses(times)
    rng, count = np.random.default_rng([seed, Stream.NOVEL_POSES]), max(4, frames // 4)
    novel = np.stack([setting.course.novel((number + 0.5) / count, rng) for number in range(count)])
    stems, novel_stems = ([f"{number:06d}" for number in range(views)] for views in (frames, count))
    (out / "images").mkdir(parents=True, exist_ok=True)
    with reporter.task(f"synth {protocol}", 2 * frames + count) as task:
        motions, depths, nearnesses, luminances = [], [], [], []
        for folder in ("observed/images", "observed/depth", "novel/images"):
            (out / "truth" / folder).mkdir(parents=True)
        for stem, time, pose in zip(stems, times, poses, strict=True):
            depth = setting.world.depth(pose, setting.lens)
            write_depth(out / "truth" / "observed" / "depth" / f"{stem}.exr", depth)
            light = _write_sharp(out / "truth" / "observed", stem, setting, pose, look)
            luminances.append(metered(light))
            motions.append(follow(path, float(time), depth, setting.lens))
            seen = depth[depth > 0]
            depths.append(float(seen.mean()))
            nearnesses.append(float((1 / seen).mean()))
            task.advance()
        faults = plan(rules, motions, luminances, seed)
        images = [f"images/{stem}.{'png' if rules.jpeg is None else 'jpg'}" for stem in stems]
        shots, rows = [], []
        if setting.film is not None:
            (out / "truth" / "moving").mkdir()
        for number, (motion, fault, nearness) in enumerate(zip(motions, faults, nearnesses, strict=True)):
            rng = np.random.default_rng([seed, Stream.EXPOSURES, number])
            light, seen = _expose(setting, motion, fault, nearness, rng)
            shots.append(develop(light, stops=fault.stops, noise=fault.noise, rng=rng, look=look))
            moving = {"moving_share": float((seen > 0).mean())}
            rows.append(_row(number, images[number], motion, fault) | formation | moving)
            if setting.film is not None:
                mask = np.repeat(np.where(seen > 0, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)
                write_rgb(out / "truth" / "moving" / f"{stems[number]}.png", mask)
            task.advance()
        if rules.phone:
            shots = coded(out / "capture.mp4", shots, FPS)
        for image, shot in zip(images, shots, strict=True):
            write_rgb(out / image, shot, quality=rules.jpeg)
        for stem, pose in zip(novel_stems, novel, strict=True):
            _write_sharp(out / "truth" / "novel", stem, setting, pose, look)
            task.advance()
    if video and not rules.phone:
        write_video(out / "capture.mp4", shots, FPS)
    write_table(out / "truth" / "frames.parquet", pa.Table.from_pylist(rows), FRAMES)
    for kind, names, exact in (("observed", stems, poses), ("novel", novel_stems, novel)):
        write_transforms(out / "truth" / kind, setting.lens, [f"images/{name}.png" for name in names], exact)
    mean_depth = float(np.mean(depths))
    noise = {"rotation_deg": rules.rotation_noise, "translation": rules.translation_noise * mean_depth}
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
        "moving": setting.film is not None,
        "blur_px": _distribution([row["blur_px"] for row in rows]),
        "rolling_shutter_px": _distribution([row["rolling_shutter_px"] for row in rows]),
        "px_at_640": REFERENCE_WIDTH / width,
        "mean_depth": mean_depth,
        "pose_noise": noise if any(noise.values()) else None,  # deviations about and along each axis
    }
    write_json(out / "truth" / "capture.json", summary)
    write_transforms(out, setting.lens, images, given)
    return summary


def _expose(
    setting: Setting,
    motion: FrameMotion,
    fault: Fault,
    nearness: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """One frame as it falls on the sensor, in linear light, and the share [H, W] that sees what moves.

    nearness: mean of 1 / depth over the pixels that see something.
    """
    shutter, aperture = motion.shutter(fault.exposure, fault.readout), PINHOLE
    if fault.defocus > 0:
        # The mean radius of a uniform disc's points is 2/3 of its rim, and `defocus` states the mean.
        focus = NEAR_FOCUS / nearness
        radius = 1.5 * fault.defocus / (setting.lens.fx * (1 / focus - nearness))
        # A disc of that many points has neighbours about a pixel apart.
        repeats = math.ceil(math.ceil(4 * fault.defocus**2) / shutter.samples)
        shutter = replace(shutter, index=np.tile(shutter.index, (repeats, 1)))
        aperture = Aperture(disc(shutter.samples, radius)[rng.permutation(shutter.samples)], focus)
    if setting.film is not None:
        return setting.film(shutter, setting.lens, aperture)
    light = setting.world.render(shutter, setting.lens, aperture)
    return light, np.zeros(light.shape[:2])


def _write_sharp(folder: Path, stem: str, setting: Setting, pose: Array, look: Look) -> Array:
    """Writes the sharp view and returns its light [H, W, 3]."""
    light = setting.world.render(still(pose, setting.lens.height), setting.lens)
    write_rgb(folder / "images" / f"{stem}.png", develop(light, look=look))
    return light


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
