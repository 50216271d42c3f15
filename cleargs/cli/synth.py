"""``cleargs synth``: synthetic captures with known ground truth."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

from cleargs.cli.common import answer, completed, json_option, parse_size, quiet_option
from cleargs.cli.progress_bars import make_reporter


def _protocols() -> Iterable[str]:
    from cleargs.synth.protocols import PROTOCOLS

    return PROTOCOLS


def _lenses() -> Iterable[str]:
    from cleargs.synth.optics import LENSES

    return LENSES


@click.command(
    epilog="""\b
Example:
  cleargs synth room --protocol mixed --frames 16 --size 480x270
  cleargs run room -o run                         use the given poses
  cleargs run room -o run --set ingest.poses=sfm  estimate the poses from the images

\b
Protocols, with mean lengths at a width of 640 px:
  sharp                                  no degradation except a little noise
  mixed                                  every other frame blurred, defocused or badly exposed
  gs2e-slight, gs2e-medium, gs2e-severe  motion blur of 6, 12 and 20 px
  gs2e-stretches                         motion blur of 14 px, almost all in groups of 12 frames
  tremor                                 motion blur of 12 px along bent paths of a hand that holds still
  gsotm-mb, gsotm-rs, gsotm-mb-rs        motion blur of 8 px, rolling shutter of 12 px, or both
  gsotm-pn                               sharp frames with inexact poses
  camera                                 the same, with an inexact focal length and distortion
  phone                                  degradations of a phone's video
  moving, moving-severe                  the same, with a person, a thing put elsewhere and a flicker
"""
)
@click.argument("out", type=click.Path(path_type=Path, file_okay=False))
@click.option(
    "--protocol",
    default="mixed",
    show_default=True,
    shell_complete=completed(_protocols),
    help="Degradations; see below.",
)
@click.option(
    "--frames", default=16, show_default=True, type=click.IntRange(2, 2000), help="Number of frames."
)
@click.option("--size", default="480x270", show_default=True, callback=parse_size, help="Image size.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Seed of room and path.")
@click.option(
    "--video",
    is_flag=True,
    help="Also write OUT/capture.mp4: 30 frames per second, with every fifth in OUT/images.",
)
@click.option(
    "--lens",
    default="phone",
    show_default=True,
    shell_complete=completed(_lenses),
    help="phone, zoom (1 to 1.8), switch (to 1.8x halfway), breathing (by 1.5 %), or fisheye (122 degrees).",
)
@json_option
@quiet_option
def synth(out: Path, size: tuple[int, int], as_json: bool, quiet: bool, **options: Any) -> None:
    """Make a synthetic handheld capture of a procedural room in the new folder OUT.

    OUT/images and OUT/transforms.json are the capture. OUT/truth holds the ground truth: sharp views with
    exact poses and depth, views off the camera path, and the degradations of each frame. With --video,
    OUT/truth/motion.parquet has pose and speed of the camera in each frame of the video.
    """
    from cleargs.synth.synthetic_capture import make_capture

    summary = make_capture(out, width=size[0], height=size[1], reporter=make_reporter(quiet), **options)
    answer(as_json, summary, *capture_lines(out, summary))


def capture_lines(out: Path, summary: dict[str, Any]) -> list[str]:
    """Return the lines that describe a new synthetic capture in ``out``."""
    frames, width = f"{summary['frames']} frames of {summary['protocol']!r}", summary["width"]
    lines = [f"{frames} in {out}; ground truth in {out / 'truth'}"]
    lines.append(_line("true blur", summary["blur_px"], width))
    if summary["rolling_shutter_px"]["max"] > 0:
        lines.append(_line("true rolling-shutter skew", summary["rolling_shutter_px"], width))
    if (noise := summary["pose_noise"]) is not None:
        lines.append(
            f"noise of the given poses, per axis: {noise['rotation_deg']:.2f} degrees and "
            f"{noise['translation']:.4f} world units"
        )
    return lines


def _line(what: str, pixels: dict[str, Any], width: int) -> str:
    quartiles = " ".join(f"{value:.1f}" for value in pixels["quartiles"])
    return (
        f"{what}: mean {pixels['mean']:.2f} px, quartiles {quartiles}, max {pixels['max']:.1f} "
        f"(images {width} px wide)"
    )
