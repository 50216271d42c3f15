"""Writes a synthetic capture: degraded frames and poses for the user, sharp truth beside them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cleargs.errors import InputError
from cleargs.files import write_json
from cleargs.media.colour import srgb_from_linear
from cleargs.media.encode import require_even, write_video
from cleargs.media.exr import write_depth
from cleargs.media.image import write_rgb
from cleargs.parquet import column, write_table
from cleargs.progress import Reporter
from cleargs.random_streams import Stream
from cleargs.synth.image_motion import SimulatedMotion, follow
from cleargs.synth.optics import PINHOLE, Aperture, Lens, disc, distorted, still
from cleargs.synth.path import FPS, HandheldPath, SceneSetup, frame_times
from cleargs.synth.phone import BITS_PER_PIXEL, PLAIN, Look, coded, metered, phone_look
from cleargs.synth.protocols import REFERENCE_WIDTH, Fault, find_protocol, noisy_poses, plan
from cleargs.synth.raycast import room_setting
from cleargs.types import ArrayF64, ImageU8

NEAR_FOCUS = 0.2
"""Where a frame out of focus is focused, as a share of the mean distance: in front of everything."""

FRAMES = pa.schema(
    [
        column("frame_id", pa.int32(), "number of the frame, as in images/"),
        column("image", pa.string(), "file below the capture"),
        column("time_s", pa.float64(), "middle of the exposure, of the middle row, seconds"),
        column("blur_px", pa.float64(), "mean length of the motion path in the image, pixels"),
        column("defocus_px", pa.float64(), "mean radius of the blur disc, pixels"),
        column("exposure_ev", pa.float64(), "exposure error, stops"),
        column("noise", pa.float64(), "deviation of the sensor noise at mid grey, sRGB units"),
        column(
            "rolling_shutter_px", pa.float64(), "mean distance in the image between first and last row's pose"
        ),
        column("exposure_s", pa.float64(), "time that the shutter is open for a row, seconds; 0: an instant"),
        column("readout_s", pa.float64(), "time from first to last row, seconds; 0: global shutter"),
        column("shutter_share", pa.float64(), "exposure_s over the time from frame to frame"),
        column("tone_contrast", pa.float64(), "contrast of the tone curve, as in phone.Look; 0: none"),
        column("tone_pivot", pa.float64(), "its pivot, sRGB in [0, 1]"),
        column("sharpening", pa.float64(), "share of the fine detail that is added; 0: none"),
        column("codec_bits_per_pixel", pa.float64(), "stated rate of the H.264 coding; 0: not coded"),
        column("moving_share", pa.float64(), "share of the pixels that see what moves; 0: nothing does"),
    ]
)
"""``truth/frames.parquet``; pixels are those of the capture's own images."""


def make_capture(
    out: Path,
    protocol: str,
    *,
    frames: int,
    width: int,
    height: int,
    seed: int,
    reporter: Reporter,
    setting: SceneSetup | None = None,
    video: bool = False,
) -> dict[str, Any]:
    """Write the capture ``protocol`` into the new folder ``out``; returns what ``truth/capture.json`` says.

    It is made in the room of ``seed``, or in another ``setting`` of as many frames of that size.
    ``out/images`` and ``out/transforms.json`` (and with ``video`` ``out/capture.mp4``) are what a user would
    have. ``out/truth/observed`` and ``out/truth/novel`` hold sharp views in the same form, 8-bit sRGB PNGs,
    with exact poses: at the middle of the frames' exposures, with ``depth/``, and off the path.
    ``out/truth/frames.parquet`` (`FRAMES`) has the faults of each frame.

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
    path, times = HandheldPath(setting.course, frames, seed, stretched=rules.stretched), frame_times(frames)
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
            if any(rules.distortion):
                light = distorted(light, setting.lens, rules.distortion)
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
        _write_transforms(out / "truth" / kind, setting.lens, [f"images/{name}.png" for name in names], exact)
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
        "focal_error": rules.focal_error,
        "distortion": list(rules.distortion),
        "pose_noise": noise if any(noise.values()) else None,  # deviations about and along each axis
    }
    write_json(out / "truth" / "capture.json", summary)
    wrong = 1 + rules.focal_error
    lens = replace(setting.lens, fx=wrong * setting.lens.fx, fy=wrong * setting.lens.fy)
    _write_transforms(out, lens, images, given)
    return summary


def _expose(
    setting: SceneSetup,
    motion: SimulatedMotion,
    fault: Fault,
    nearness: float,
    rng: np.random.Generator,
) -> tuple[ArrayF64, ArrayF64]:
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


def _write_sharp(folder: Path, stem: str, setting: SceneSetup, pose: ArrayF64, look: Look) -> ArrayF64:
    """Writes the sharp view and returns its light [H, W, 3]."""
    light = setting.world.render(still(pose, setting.lens.height), setting.lens)
    write_rgb(folder / "images" / f"{stem}.png", develop(light, look=look))
    return light


def develop(
    image: ArrayF64,
    *,
    stops: float = 0.0,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
    look: Look = PLAIN,
) -> ImageU8:
    """Exposure error, sensor noise, clipping, sRGB encoding, the camera's look, 8 bits: RGB [H, W, 3] from
    linear light.

    The noise is signal-dependent: ``noise`` is its deviation in sRGB units at mid grey of a frame exposed
    by ``stops``, of whose square 70 % is shot noise and the rest is read noise.
    """
    image = image * 2.0**stops
    if rng is not None:
        mid_grey_slope = 0.6  # d linear / d sRGB at mid grey: carries the stated deviation into linear light
        shape = np.sqrt(np.clip(image, 0, None) / 0.2 * 0.7 + 0.3)
        image = image + rng.standard_normal(image.shape) * noise * mid_grey_slope * shape
    return np.asarray(np.rint(look.apply(srgb_from_linear(np.clip(image, 0, 1))) * 255), np.uint8)


def _row(number: int, image: str, motion: SimulatedMotion, fault: Fault) -> dict[str, Any]:
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


def _write_transforms(folder: Path, lens: Lens, images: Sequence[str], poses: ArrayF64) -> None:  # [F, 3, 4]
    """``transforms.json`` as nerfstudio reads it: OpenGL camera to world."""
    frames = []
    for image, pose in zip(images, poses, strict=True):
        matrix = np.vstack([pose, [0, 0, 0, 1]]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": image, "transform_matrix": matrix.tolist()})
    camera = {"camera_model": "OPENCV", "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    write_json(folder / "transforms.json", {**camera, "w": lens.width, "h": lens.height, "frames": frames})


def _distribution(values: list[float]) -> dict[str, Any]:
    low, middle, high = (float(value) for value in np.quantile(values, [0.25, 0.5, 0.75]))
    return {"mean": float(np.mean(values)), "quartiles": [low, middle, high], "max": max(values)}
