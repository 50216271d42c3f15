"""``cleargs synth``: captures with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cleargs.cli.common import json_option, parse_size, print_json
from cleargs.cli.progress_bars import make_reporter

PROTOCOL_HELP = (
    "One of sharp, mixed, gs2e-slight, gs2e-medium, gs2e-severe, gs2e-stretches, gsotm-mb, gsotm-rs, "
    "gsotm-mb-rs, gsotm-pn, camera, phone."
)


@click.command(
    epilog="""\b
Example:
  cleargs synth room --protocol mixed --frames 16 --size 480x270
  cleargs run room -o run                        uses the given poses
  cleargs run room -o run --set ingest.poses=sfm  starts from the images alone
"""
)
@click.argument("out", type=click.Path(path_type=Path, file_okay=False))
@click.option("--protocol", default="mixed", show_default=True, help=PROTOCOL_HELP)
@click.option(
    "--frames", default=16, show_default=True, type=click.IntRange(2, 2000), help="How many frames."
)
@click.option("--size", default="480x270", show_default=True, callback=parse_size, help="Image size.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Another room and walk.")
@click.option("--video", is_flag=True, help="Also write OUT/capture.mp4.")
@json_option
def synth(
    out: Path,
    protocol: str,
    frames: int,
    size: tuple[int, int],
    seed: int,
    video: bool,
    as_json: bool,
) -> None:
    """Make a synthetic handheld capture of a procedural room in the new folder OUT.

    OUT/images and OUT/transforms.json are a capture like any other; OUT/truth holds the sharp views with
    exact poses and depth, views off the path, and what is wrong with each frame.
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
    )
    if as_json:
        print_json(summary)
    else:
        print_capture(out, summary)


def print_capture(out: Path, summary: dict[str, Any]) -> None:
    """Say what `cleargs.synth.synthetic_capture.make_capture` made in ``out``."""
    width = summary["width"]
    click.echo(
        f"{summary['frames']} frames of {summary['protocol']!r} in {out}; the truth in {out / 'truth'}"
    )
    click.echo(_line("true blur", summary["blur_px"], width))
    if summary["rolling_shutter_px"]["max"] > 0:
        click.echo(_line("true rolling-shutter skew", summary["rolling_shutter_px"], width))
    if (noise := summary["pose_noise"]) is not None:
        click.echo(
            f"noise on the given poses: {noise['rotation_deg']:.2f} degrees about and "
            f"{noise['translation']:.4f} world units along each axis"
        )


def _line(what: str, pixels: dict[str, Any], width: int) -> str:
    quartiles = " ".join(f"{value:.1f}" for value in pixels["quartiles"])
    return (
        f"{what}: mean {pixels['mean']:.2f} px, quartiles {quartiles}, max {pixels['max']:.1f} "
        f"(images {width} px wide)"
    )
