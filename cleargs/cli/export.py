"""``cleargs export``: write the scene for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cleargs.cli.common import FILE, answer, json_option, quiet_option, scene_argument, scene_option
from cleargs.cli.progress_bars import make_reporter
from cleargs.errors import InputError
from cleargs.pipeline.dag import Dag
from cleargs.render import TARGETS
from cleargs.run_results import scene_stage


@click.command(
    epilog="""\b
Examples:
  cleargs export room --for blender                writes room-blender.ply
  cleargs export room --for web -o site/room.spz   y is up; for Spark and three.js
  cleargs export room -o room.ply -o room.sog      two formats in one call
  cleargs export room -o room.ply --metres 0-40=3.5   frames 0 and 40 were filmed 3.5 m apart
  cleargs export room --for blender --upright 0:left   the camera was held sideways
  cleargs export room -o room.ply --world input    in the world of the capture's poses
  cleargs export room -o room.sog --prune contribution:0.1 --crop percentile:98
  cleargs export other.spz -o other.ply            a scene file of any program

\b
Formats:
  .ply              all values; read by most programs
  .compressed.ply   a quarter of the size: SuperSplat, Spark, Brush
  .sog              a fifth of the size: SuperSplat, PlayCanvas, Spark
  .spz              a sixth of the size: Spark, Babylon, Blender, Scaniverse; not for worlds that are very
                    small or large. Spark and Scaniverse expect y up in it, as written by default. The
                    programs that read it like a .ply (SuperSplat, Babylon, Open3D) need --up=-y
  .glb .usdc        glTF and OpenUSD

\b
Programs of --for:
"""
    + "\n".join(f"  {name:<12} .{target.ending}, {target.hint}" for name, target in TARGETS.items())
)
@scene_argument
@click.option(
    "--sh-degree",
    type=click.IntRange(0, 3),
    help="Pad the spherical harmonics with zeros up to this degree.  [default: as trained]",
)
@click.option(
    "--world",
    type=click.Choice(["normalised", "input"]),
    default="normalised",
    show_default=True,
    help="World of the file: that of the run (normalised), or that of the capture's poses (input).",
)
@click.option(
    "--up",
    type=click.Choice(["-y", "y", "z"]),
    help="Turn the scene so that this axis points up (write --up=-y with =). The camera of the "
    "first frame is then at the origin and looks ahead. "
    "Use y for Spark and three.js, z for Blender.  [default: the axes of SuperSplat]",
)
@click.option(
    "--upright",
    metavar="FRAME:SIDE|X,Y,Z",
    help="Turn the scene so that a side (top, left, right, bottom) of the picture of a frame points up, or a "
    "direction in the coordinates of cameras.json. For scenes that lie on their side.",
)
@click.option(
    "--prune",
    multiple=True,
    metavar="opacity:O|contribution:P",
    help="Leave out Gaussians with an opacity below O (0 to 1), or with a contribution below P pixels to "
    "every training frame. Prints the loss of PSNR. May be given twice.",
)
@click.option(
    "--crop",
    metavar="box:X,Y,Z,X,Y,Z|percentile:P",
    help="Keep the Gaussians in a box. Give two corners in the coordinates of cameras.json, or P for the "
    "middle P percent along each axis.",
)
@click.option(
    "--spz",
    type=click.Choice([3, 4]),
    help="Version of an .spz: 4 for PlayCanvas, 3 for all others.  [default: 3]",
)
@scene_option
@click.option(
    "--for",
    "program",
    type=click.Choice(list(TARGETS)),
    help="Choose format, axes and degree of the harmonics for this program.",
)
@click.option(
    "--metres",
    metavar="A-B=D",
    help="Scale the scene so that the cameras of frames A and B are D metres apart.",
)
@click.option(
    "-o",
    "--output",
    "outputs",
    multiple=True,
    type=FILE,
    help="The new file, whose ending chooses the format. May be given several times.",
)
@click.option(
    "--cameras", is_flag=True, help="Also write FILE.cameras.json and the COLMAP model FILE.colmap."
)
@click.option("--force", is_flag=True, help="Replace existing files.")
@json_option
@quiet_option
@click.pass_obj
def export(
    dag: Dag,
    /,
    run: Path,
    chosen: str | None,
    program: str | None,
    outputs: tuple[Path, ...],
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Write the scene of RUN, or a scene file of any program, to one or several files."""
    from cleargs.render.export import ExportOptions, export_file, export_scene

    target = TARGETS[program] if program is not None else None
    if target is not None:
        name = run.resolve().name if run.is_dir() else run.name.split(".")[0]
        outputs = outputs or (Path(f"{name}-{program}.{target.ending}"),)
        for name in ("up", "sh_degree", "spz"):
            options[name] = getattr(target, name) if options[name] is None else options[name]
    if not outputs:
        raise InputError("no file is given", hint="give -o FILE, or --for PROGRAM")
    given = ExportOptions(**{**options, "spz": options["spz"] or 3})
    stage = None if run.is_file() and chosen is None else scene_stage(dag, run, chosen)
    if stage is None:
        lines = export_file(run, outputs, given)
    else:
        lines = export_scene(run, stage, outputs, given, make_reporter(quiet))
    if target is not None:
        lines.append(f"{program}: {target.hint}")
    answer(as_json, {"files": list(map(str, outputs)), "stage": stage, "messages": lines}, *lines)
