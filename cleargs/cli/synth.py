"""``cleargs synth``: synthetic captures with known ground truth."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

from cleargs.cli.common import completed, json_option, parse_size, print_json
from cleargs.cli.progress_bars import make_reporter

PROTOCOL_HELP = (
    "Degradations: sharp, mixed, gs2e-slight, gs2e-medium, gs2e-severe, gs2e-stretches, tremor, gsotm-mb, "
    "gsotm-rs, gsotm-mb-rs, gsotm-pn, camera, phone, moving or moving-severe."
)


def _protocols() -> Iterable[str]:
    from cleargs.synth.protocols import PROTOCOLS

    return PROTOCOLS


@click.command(
    epilog="""\b
Example:
  cleargs synth room --protocol mixed --frames 16 --size 480x270
  cleargs run room -o run                         use the given poses
  cleargs run room -o run --set ingest.poses=sfm  estimate the poses from the images
  cleargs synth clip --protocol phone --seconds 60 --fps 30 --size 960x540

\b
Protocols, with mean lengths at a width of 640 px:
  sharp                                  no degradation except a little noise
  mixed                                  every other frame blurred, defocused or badly exposed
  gs2e-slight, gs2e-medium, gs2e-severe  motion blur of 6, 12 and 20 px
  gs2e-stretches                         motion blur of 14 px, almost all in groups of 12 frames
  tremor                                 motion blur of 12 px along bent paths of a hand that holds still
  gsotm-mb, gsotm-rs, gsotm-mb-rs        motion blur of 8 px, rolling shutter of 12 px, or both
  gsotm-pn                               sharp frames with inexact poses
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
    help=PROTOCOL_HELP,
)
@click.option(
    "--frames", default=16, show_default=True, type=click.IntRange(2, 2000), help="Number of frames."
)
@click.option("--size", default="480x270", show_default=True, callback=parse_size, help="Image size.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Seed of room and path.")
@click.option("--video", is_flag=True, help="Also write OUT/capture.mp4.")
@click.option(
    "--seconds", type=click.FloatRange(0.1, 600), help="Length of the walk.  [default: 1/6 s per frame]"
)
@click.option(
    "--fps",
    type=click.FloatRange(1, 120),
    help="Frame rate of OUT/capture.mp4, which then shows the whole walk; --frames have ground truth.",
)
@json_option
def synth(
    out: Path,
    protocol: str,
    frames: int,
    size: tuple[int, int],
    seed: int,
    video: bool,
    seconds: float | None,
    fps: float | None,
    as_json: bool,
) -> None:
    """Make a synthetic handheld capture of a procedural room in the new folder OUT.

    OUT/images and OUT/transforms.json are the capture. OUT/truth holds the ground truth: sharp views with
    exact poses and depth, views off the camera path, and the degradations of each frame.
    """
    from cleargs.synth.synthetic_capture import make_capture

    summary = make_capture(
        out,
        protocol,
        frames=frames,
        width=size[0],
        height=size[1],
        seed=seed,
        reporter=make_reporter(),
        video=video,
        seconds=seconds,
        fps=fps,
    )
    if as_json:
        print_json(summary)
    else:
        print_capture(out, summary)


def print_capture(out: Path, summary: dict[str, Any]) -> None:
    """Print the ``summary`` of `cleargs.synth.synthetic_capture.make_capture` for the capture in ``out``."""
    width = summary["width"]
    click.echo(
        f"{summary['frames']} frames of {summary['protocol']!r} in {out}; ground truth in {out / 'truth'}"
    )
    click.echo(_line("true blur", summary["blur_px"], width))
    if summary["rolling_shutter_px"]["max"] > 0:
        click.echo(_line("true rolling-shutter skew", summary["rolling_shutter_px"], width))
    if (noise := summary["pose_noise"]) is not None:
        click.echo(
            f"noise of the given poses, per axis: {noise['rotation_deg']:.2f} degrees and "
            f"{noise['translation']:.4f} world units"
        )


def _line(what: str, pixels: dict[str, Any], width: int) -> str:
    quartiles = " ".join(f"{value:.1f}" for value in pixels["quartiles"])
    return (
        f"{what}: mean {pixels['mean']:.2f} px, quartiles {quartiles}, max {pixels['max']:.1f} "
        f"(images {width} px wide)"
    )
