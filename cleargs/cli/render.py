"""``cleargs render``: pictures and films of a finished scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cleargs.cli.common import (
    FILE,
    answer,
    edited_option,
    json_option,
    parse_size,
    quiet_option,
    scene_argument,
    scene_option,
    work_options,
)
from cleargs.cli.progress_bars import make_reporter
from cleargs.pipeline.session import DeviceChoice, resolve_device
from cleargs.pipeline.stages import Stages
from cleargs.report.formatting import count as count_of
from cleargs.run_results import scene_origin, scene_stage


@click.command(
    epilog="""\b
Examples:
  cleargs render room -o room.mp4                       along the smoothed camera path
  cleargs render room -o room.mp4 --side-by-side        the capture on the left, the scene on the right
  cleargs render room -o turn.mp4 --turntable --size 1920x1080 --seconds 8 --codec av1
  cleargs render room -o still.png --frame 12           at the pose of frame 12
  cleargs render room -o still.exr --frame 12           scene-linear RGB, alpha and depth
  cleargs render room -o shots/%04d.exr --poses shots.json
  cleargs render room -o room.mp4 --scene edited.ply    an edited copy of the scene
  cleargs render other.spz -o %04d.png --poses shots.json   a scene file of any program

\b
FILE.mp4 is a film. FILE.png and FILE.exr are stills. FOLDER/%04d.png and .exr are numbered stills with a
file cameras.json. An EXR holds R, G, B and A over black, and Z, the depth along the optical axis in the
units of the run. --poses reads cameras.json of `cleargs export` and transforms.json of nerfstudio, and
renders a picture for each pose.
"""
)
@scene_argument
@click.option(
    "--frame", type=click.IntRange(min=0), metavar="N", help="Render a still at the pose of this frame."
)
@click.option(
    "--turntable",
    is_flag=True,
    help="Circle around what the cameras look at. If they saw one side only, swing back and forth.",
)
@click.option(
    "--poses",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="FILE.json",
    help="Render a picture at each pose in this file.",
)
@click.option(
    "--world",
    type=click.Choice(["normalised", "input"]),
    help="World of the poses in --poses: that of the run (normalised), or that of the capture (input).  "
    "[default: normalised for cameras.json, input for transforms.json]",
)
@scene_option
@edited_option
@click.option(
    "--size", callback=parse_size, metavar="WxH", help="Size of a picture.  [default: size of the frames]"
)
@click.option(
    "--fps", type=click.FloatRange(1, 240), default=30.0, show_default=True, help="Pictures per second."
)
@click.option(
    "--seconds",
    type=click.FloatRange(min=0, min_open=True, max=36_000),
    help="Length of the film.  [default: 10]",
)
@click.option(
    "--side-by-side",
    is_flag=True,
    help="Show the nearest frame of the capture on the left, which doubles the width.",
)
@click.option(
    "--codec",
    type=click.Choice(["h264", "av1"]),
    default="h264",
    show_default=True,
    help="Codec of a film: h264 plays everywhere, av1 takes less space.",
)
@click.option("-o", "--output", required=True, type=FILE, help="The new file: .mp4, .png or .exr.")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@work_options
@json_option
@quiet_option
@click.pass_obj
def render(
    dag: Stages,
    /,
    run: Path,
    chosen: str | None,
    output: Path,
    force: bool,
    device: DeviceChoice,
    threads: int,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Render the scene of RUN or a scene file: a film along the camera path, a turntable, or stills.

    A scene file has no cameras: it needs --poses, in its own world. Without --frame, --turntable and
    --poses, a film and numbered stills follow the camera path. A single still is taken in the middle of it.
    """
    from cleargs.render.shots import ShotOptions, render_run
    from cleargs.splat.backend import set_threads

    given = ShotOptions(**options)
    given.check(output)
    stage = run.name if run.is_file() and chosen is None else scene_stage(dag, run, chosen)
    reporter = make_reporter(quiet)
    on = resolve_device(device, reporter.info)
    set_threads(threads)
    shots = render_run(run, stage, output, given, reporter, force=force, device=on)
    camera = shots[0].camera
    width = camera.width * (2 if given.side_by_side else 1)
    facts = {"file": str(output), "stage": stage, "pictures": len(shots)}
    origin = str(given.scene or (stage if run.is_file() else scene_origin(dag, run, stage)))
    answer(
        as_json,
        {**facts, "width": width, "height": camera.height},
        f"{output}: {count_of(len(shots), 'picture')} of {width}x{camera.height}, scene of {origin}",
    )
