"""Writer of synthetic captures: degraded frames and poses as input, and sharp ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
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
from cleargs.parquet import column, write_table
from cleargs.progress import Reporter, log_reporter
from cleargs.random_streams import Stream
from cleargs.synth import phone
from cleargs.synth.image_motion import SimulatedMotion, track_motion
from cleargs.synth.native_video import MOTION, NATIVE_FPS, STRIDE, native_frames, true_motion
from cleargs.synth.optics import LENSES, PINHOLE, Aperture, Lens, disc, distorted, instant_shutter, lens_at
from cleargs.synth.path import FPS, SHOT_SECONDS, HandheldPath, SceneSetup, frame_times
from cleargs.synth.protocols import PROTOCOLS, REFERENCE_WIDTH, Fault, Protocol, noisy_poses, plan_faults
from cleargs.synth.raycast import room_setup
from cleargs.types import ArrayF64, ImageU8

PATH_POSES = 17
"""Number of poses of the true path of an exposure in ``truth/frames.parquet``."""
NEAR_FOCUS = 0.2
"""Focus distance of a defocused frame, as a share of the mean distance: in front of all surfaces."""

FRAMES = pa.schema(
    [
        column("frame_id", pa.int32(), "number of the frame, as in images/"),
        column("image", pa.string(), "file below the capture"),
        column("time_s", pa.float64(), "middle of the middle row's exposure, seconds"),
        column("blur_px", pa.float64(), "mean length of the motion path in the image, pixels"),
        column("defocus_px", pa.float64(), "mean radius of the blur disc, pixels"),
        column("exposure_ev", pa.float64(), "exposure error, stops"),
        column("noise", pa.float64(), "standard deviation of the sensor noise at mid grey, sRGB units"),
        column(
            "rolling_shutter_px",
            pa.float64(),
            "mean distance in the image between the poses of first and last row, pixels",
        ),
        column("exposure_s", pa.float64(), "exposure time of a row, seconds; 0: no motion blur"),
        column(
            "path",
            pa.list_(pa.float64()),
            f"camera to world at {PATH_POSES} even times from the start to the end of the middle row's "
            "exposure: matrices [3, 4] with OpenCV axes, row by row, one after the other",
        ),
        column("readout_s", pa.float64(), "time from first to last row, seconds; 0: global shutter"),
        column("shutter_share", pa.float64(), "exposure_s divided by the time between frames"),
        column("tone_contrast", pa.float64(), "contrast of the tone curve, as in phone.Tone; 0: none"),
        column("tone_pivot", pa.float64(), "pivot of the tone curve, sRGB in [0, 1]"),
        column("sharpening", pa.float64(), "factor of the fine detail that is added; 0: none"),
        column("codec_bits_per_pixel", pa.float64(), "target rate of the H.264 coding; 0: not coded"),
        column("moving_share", pa.float64(), "share of the pixels that see movement; 0: none"),
    ]
)
"""``truth/frames.parquet``. Lengths in pixels are those of the capture's images."""


def make_capture(
    out: str | Path,
    protocol: str = "mixed",
    *,
    frames: int = 16,
    width: int = 480,
    height: int = 270,
    seed: int = 0,
    reporter: Reporter | None = None,
    setup: SceneSetup | None = None,
    video: bool = False,
    lens: str = "phone",
) -> dict[str, Any]:
    """Write a capture into a new folder.

    ``out/images`` and ``out/transforms.json`` are the input of a run. ``out/truth/observed`` and
    ``out/truth/novel`` have the same layout with sharp 8-bit sRGB PNGs and exact poses: observed views are at
    the middle of the frames' exposures, novel views are off the path; both have ``depth/``.
    ``out/truth/frames.parquet`` (`FRAMES`) has the faults of each frame.

    The truth does not contain what moves in a world. ``out/truth/moving`` has a mask per frame: white for
    pixels that saw movement during the exposure. Shadows, and what a thing that was put elsewhere has left
    free, are not in the mask.

    Args:
        out: The folder, empty or not existing.
        protocol: Name in `cleargs.synth.protocols.PROTOCOLS`.
        frames: Number of frames.
        width: Width of the images, px.
        height: Height of the images, px.
        seed: Seed of the room, the walk and the faults.
        reporter: Receives the progress (default: the logger ``cleargs``).
        setup: World, course and lens for this number and size of frames; None: the room of ``seed``.
        video: Write ``out/capture.mp4`` with 30 frames per second, of which the capture has every fifth, and
            ``out/truth/motion.parquet`` (`cleargs.synth.native_video.MOTION`). Without it, only the protocols
            of a phone write a video, with the frames of the capture.
        lens: Lens of the frames, one of `cleargs.synth.optics.LENSES`.

    Returns:
        The contents of ``truth/capture.json``.

    Raises:
        InputError: if the protocol is unknown or has no video, the folder is not empty, or a video cannot
            have this size.

    Example:
        cg.make_capture("small", "gs2e-medium", frames=4, width=96, height=64)
    """
    out, reporter = Path(out), reporter or log_reporter()
    rules = PROTOCOLS.get(protocol)
    if rules is None:
        raise InputError(f"no protocol is called {protocol!r}", hint=f"choose one of {', '.join(PROTOCOLS)}")
    if lens not in LENSES:
        raise InputError(f"no lens is called {lens!r}", hint=f"choose one of {', '.join(LENSES)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is not empty", hint="choose a new folder for the capture")
    if video and rules.shots:
        raise InputError(
            f"the protocol {protocol} has no video: it takes one photograph per second",
            hint="leave the video out, or choose another protocol, such as gs2e-medium",
        )
    if video or rules.phone:
        require_even(width, height)
    rate = 1 / SHOT_SECONDS if rules.shots else FPS
    setup = setup or room_setup(frames, width, height, seed, rules.moving)
    tone = phone.tone_of(seed) if rules.phone else phone.PLAIN
    processing = {
        "tone_contrast": tone.contrast,
        "tone_pivot": tone.pivot,
        "sharpening": tone.sharpening,
        "codec_bits_per_pixel": phone.BITS_PER_PIXEL if rules.phone else 0.0,
    }
    if not rules.phone:
        setup = replace(setup, film=None)
    path = HandheldPath(setup.course, frames, seed, stretched=rules.stretched, shots=rules.shots)
    times = frame_times(frames, rate)
    poses = path.poses(times)
    lenses = [lens_at(lens, setup.lens, number / max(1, frames - 1)) for number in range(frames)]
    rng, count = np.random.default_rng([seed, Stream.NOVEL_POSES]), max(4, frames // 4)
    novel = np.stack([setup.course.novel((number + 0.5) / count, rng) for number in range(count)])
    stems, novel_stems = ([f"{number:06d}" for number in range(views)] for views in (frames, count))
    (out / "images").mkdir(parents=True, exist_ok=True)
    steps = (1 + STRIDE if video else 2) * frames + count
    with reporter.task(f"making the capture {protocol}", steps) as task:
        task.update(note="compiling first, once on this machine")
        motions, depths, nearnesses, luminances = [], [], [], []
        for folder in ("observed/images", "observed/depth", "novel/images", "novel/depth"):
            (out / "truth" / folder).mkdir(parents=True)
        for stem, time, pose, own in zip(stems, times, poses, lenses, strict=True):
            light, depth = _write_sharp(
                out / "truth" / "observed", stem, replace(setup, lens=own), pose, tone
            )
            luminances.append(phone.metered_luminance(light))
            motions.append(track_motion(path, float(time), depth, own))
            seen = depth[depth > 0]
            depths.append(float(seen.mean()))
            nearnesses.append(float((1 / seen).mean()))
            task.update(done=len(depths), note="")
        faults = plan_faults(rules, motions, luminances, rate, seed)
        images = [f"images/{stem}.{'png' if rules.jpeg is None else 'jpg'}" for stem in stems]
        shots, rows = [], []
        if setup.film is not None:
            (out / "truth" / "moving").mkdir()
        for number, (motion, fault, nearness) in enumerate(zip(motions, faults, nearnesses, strict=True)):
            rng = np.random.default_rng([seed, Stream.EXPOSURES, number])
            shot, seen = _shoot(setup, rules, tone, motion, fault, nearness, rng)
            shots.append(shot)
            moving = {"moving_share": float((seen > 0).mean())}
            rows.append(_row(number, images[number], motion, fault, rate) | processing | moving)
            if setup.film is not None:
                mask = np.repeat(np.where(seen > 0, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)
                write_rgb(out / "truth" / "moving" / f"{stems[number]}.png", mask)
            task.advance()
        filmed = shots
        if rules.phone:
            shots = phone.encode_and_decode(out / "capture.mp4", filmed, rate)
        for image, shot in zip(images, shots, strict=True):
            write_rgb(out / image, shot, quality=rules.jpeg)
        for stem, pose in zip(novel_stems, novel, strict=True):
            _write_sharp(out / "truth" / "novel", stem, setup, pose, tone)
            task.advance()
        if video:
            native = native_frames(motions, faults)

            def all_shots() -> Iterator[ImageU8]:
                for number, (motion, fault) in enumerate(native):
                    chosen, place = divmod(number, STRIDE)
                    if place == STRIDE // 2:
                        yield filmed[chosen]
                        continue
                    # Not 0 at the end: NumPy reads such a seed like the shorter one of a chosen frame.
                    rng = np.random.default_rng([seed, Stream.EXPOSURES, chosen, place + 1])
                    own = lens_at(lens, setup.lens, min(1.0, number / max(1, len(native) - 1)))
                    motion = replace(motion, lens=own)
                    yield _shoot(setup, rules, tone, motion, fault, nearnesses[chosen], rng)[0]
                    task.advance()

            bits = processing["codec_bits_per_pixel"] or None
            write_video(out / "capture.mp4", all_shots(), NATIVE_FPS, bits, repeatable=True)
            write_table(out / "truth" / "motion.parquet", true_motion(native, images), MOTION)
    write_table(out / "truth" / "frames.parquet", pa.Table.from_pylist(rows), FRAMES)
    for kind, names, used, exact in (
        ("observed", stems, lenses, poses),
        ("novel", novel_stems, [setup.lens] * count, novel),
    ):
        _write_transforms(out / "truth" / kind, used, [f"images/{name}.png" for name in names], exact)
    mean_depth = float(np.mean(depths))
    noise = {"rotation_deg": rules.rotation_noise, "translation": rules.translation_noise * mean_depth}
    summary = {
        "protocol": protocol,
        "seed": seed,
        "world": setup.name,
        "frames": frames,
        "width": width,
        "height": height,
        "fps": rate,
        "video_fps": NATIVE_FPS if video else rate if rules.phone else None,
        "jpeg_quality": rules.jpeg,
        "codec_bits_per_pixel": processing["codec_bits_per_pixel"],
        "moving": setup.film is not None,
        "lens": lens,
        "blur_px": _distribution([row["blur_px"] for row in rows]),
        "rolling_shutter_px": _distribution([row["rolling_shutter_px"] for row in rows]),
        "px_at_640": REFERENCE_WIDTH / width,
        "mean_depth": mean_depth,
        "focal_error": rules.focal_error,
        "distortion": list(rules.distortion),
        "pose_noise": noise if any(noise.values()) else None,  # standard deviations per axis
    }
    write_json(out / "truth" / "capture.json", summary)
    wrong = [own.zoomed(1 + rules.focal_error) for own in lenses]
    _write_transforms(out, wrong, images, noisy_poses(poses, rules, mean_depth, seed))
    return summary


def _shoot(
    setup: SceneSetup,
    rules: Protocol,
    tone: phone.Tone,
    motion: SimulatedMotion,
    fault: Fault,
    nearness: float,  # mean of 1 / depth over the pixels that see a surface
    rng: np.random.Generator,  # for the order of the points on the lens, and the noise
) -> tuple[ImageU8, ArrayF64]:
    """Return a frame before its codec, and per pixel [H, W] the share of the exposure that sees movement."""
    shutter, aperture, lens = motion.shutter(fault.exposure, fault.readout), PINHOLE, motion.lens
    if fault.defocus > 0:
        # `defocus` is the mean radius over the points of a uniform disc, which is 2/3 of the disc's radius.
        focus = NEAR_FOCUS / nearness
        radius = 1.5 * fault.defocus / (lens.fx * (1 / focus - nearness))
        # With this number of points neighbours in the disc are about a pixel apart.
        repeats = math.ceil(math.ceil(4 * fault.defocus**2) / shutter.samples)
        shutter = replace(shutter, index=np.tile(shutter.index, (repeats, 1)))
        aperture = Aperture(disc(shutter.samples, radius)[rng.permutation(shutter.samples)], focus)
    seen = np.zeros((lens.height, lens.width))
    if setup.film is None:
        light = setup.world.render(shutter, lens, aperture)
    else:
        light, seen = setup.film(shutter, lens, aperture)
    if any(rules.distortion):
        light = distorted(light, lens, rules.distortion)
    return phone.develop(light, stops=fault.stops, noise=fault.noise, rng=rng, tone=tone), seen


def _write_sharp(
    folder: Path, stem: str, setup: SceneSetup, pose: ArrayF64, tone: phone.Tone
) -> tuple[ArrayF64, ArrayF64]:
    """Write a sharp view and its depth. Return its linear light [H, W, 3] and camera z [H, W]."""
    light = setup.world.render(instant_shutter(pose, setup.lens.height), setup.lens)
    write_rgb(folder / "images" / f"{stem}.png", phone.develop(light, tone=tone))
    depth = setup.world.depth(pose, setup.lens)
    write_depth(folder / "depth" / f"{stem}.exr", depth)
    return light, depth


def _row(number: int, image: str, motion: SimulatedMotion, fault: Fault, rate: float) -> dict[str, Any]:
    during = motion.time + fault.exposure * np.linspace(-0.5, 0.5, PATH_POSES)
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
        "path": motion.path.poses(during).ravel().tolist(),
        "shutter_share": fault.exposure * rate,
        "readout_s": fault.readout,
    }


def _write_transforms(folder: Path, lenses: Sequence[Lens], images: Sequence[str], poses: ArrayF64) -> None:
    """Write ``transforms.json`` as nerfstudio reads it, with OpenGL camera-to-world matrices.

    Focal lengths are those of each frame if the ``lenses`` of the ``poses`` [F, 3, 4] differ.
    """
    lens, frames = lenses[0], []
    several = len(set(lenses)) > 1
    for image, pose, own in zip(images, poses, lenses, strict=True):
        matrix = np.vstack([pose, [0, 0, 0, 1]]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        focal = {"fl_x": own.fx, "fl_y": own.fy} if several else {}
        frames.append({"file_path": image, "transform_matrix": matrix.tolist(), **focal})
    model = "OPENCV_FISHEYE" if lens.fisheye else "OPENCV"
    camera = {"camera_model": model, "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    write_json(folder / "transforms.json", {**camera, "w": lens.width, "h": lens.height, "frames": frames})


def _distribution(values: list[float]) -> dict[str, Any]:
    low, middle, high = (float(value) for value in np.quantile(values, [0.25, 0.5, 0.75]))
    return {"mean": float(np.mean(values)), "quartiles": [low, middle, high], "max": max(values)}
