"""``cleargs export``: write the scene for other programs."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Any

import click
from click.core import ParameterSource

from cleargs.cli.common import (
    FILE,
    answer,
    edited_option,
    json_option,
    quiet_option,
    scene_argument,
    scene_option,
)
from cleargs.cli.progress_bars import make_reporter
from cleargs.errors import InputError
from cleargs.pipeline.stages import Stages, installed
from cleargs.progress import Reporter
from cleargs.render import TARGETS
from cleargs.run_results import scene_stage

_OF_CAPTURE = frozenset({"run", "capture", "repeat", "deblurred", "as_json", "quiet", "log", "progress"})
"""Parameters of `export` that ``--capture`` may have next to it."""


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
  cleargs export room -o room.ply --drop sphere:0.2,-1,3,0.1   without a floater
  cleargs export room -o room.sog --scene edited.ply   a copy from which an editor cut floaters
  cleargs export other.spz -o other.ply            a scene file of any program
  cleargs export room --capture room-data          frames and poses for nerfstudio, gsplat, Brush

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
    help="Keep the Gaussians in a box. Give two corners in the coordinates of the file, which the report's "
    "3D view shows, or P for the middle P percent along each axis.",
)
@click.option(
    "--drop",
    multiple=True,
    metavar="sphere:X,Y,Z,R",
    help="Leave out the Gaussians in a sphere, such as a floater. May be given several times.",
)
@click.option(
    "--spz",
    type=click.Choice([3, 4]),
    help="Version of an .spz: 4 for PlayCanvas, 3 for all others.  [default: 3]",
)
@scene_option
@edited_option
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
@click.option(
    "--capture",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Write the capture in place of the scene: frames, poses, points and split for nerfstudio, gsplat, "
    "Brush and other trainers. Frames to which RVA gives no weight are left out.",
)
@click.option(
    "--repeat",
    type=click.IntRange(1, 20),
    default=1,
    help="With --capture: write a training frame of weight w this number times w (rounded, at least once), "
    "for trainers that know no weights.  [default: 1]",
)
@click.option(
    "--deblurred",
    is_flag=True,
    help="With --capture: undo the motion, rolling shutter and defocus of training frames. Needs a scene.",
)
@click.option("--force", is_flag=True, help="Replace existing files.")
@json_option
@quiet_option
@click.pass_obj
def export(
    dag: Stages,
    /,
    run: Path,
    chosen: str | None,
    program: str | None,
    outputs: tuple[Path, ...],
    as_json: bool,
    quiet: bool,
    capture: Path | None,
    repeat: int,
    deblurred: bool,
    **options: Any,
) -> None:
    """Write the scene of RUN, or a scene file of any program, to one or several files."""
    from cleargs.render.export import ExportOptions, export_file, export_scene

    if capture is not None:
        context = click.get_current_context()
        wrong = [
            one.opts[-1]
            for one in context.command.params
            if one.name not in _OF_CAPTURE
            and context.get_parameter_source(one.name or "") is ParameterSource.COMMANDLINE
        ]
        if wrong:
            raise InputError("--capture writes no scene", hint=f"leave out {', '.join(wrong)}")
        _export_capture(run, capture, repeat, deblurred, make_reporter(quiet), as_json)
        return
    if repeat > 1 or deblurred:
        raise InputError("--repeat and --deblurred are for --capture FOLDER", hint="leave them out")
    target = TARGETS[program] if program is not None else None
    if target is not None:
        name = run.resolve().name if run.is_dir() else run.name.split(".")[0]
        outputs = outputs or (Path(f"{name}-{program}.{target.ending}"),)
        for name in ("up", "sh_degree", "spz"):
            options[name] = getattr(target, name) if options[name] is None else options[name]
    if not outputs:
        raise InputError("no file is given", hint="give -o FILE, or --for PROGRAM")
    given = ExportOptions(**{**options, "spz": options["spz"] or 3}, views=program == "web")
    stage = None if run.is_file() and chosen is None else scene_stage(dag, run, chosen)
    if stage is None:
        lines = export_file(run, outputs, given)
    else:
        lines = export_scene(run, stage, outputs, given, make_reporter(quiet))
    if target is not None:
        lines.append(f"{program}: {target.hint}")
    answer(as_json, {"files": list(map(str, outputs)), "stage": stage, "messages": lines}, *lines)


def _export_capture(
    run: Path, folder: Path, repeat: int, deblurred: bool, reporter: Reporter, as_json: bool
) -> None:
    """Write the frames of ``run`` for other trainers."""
    from cleargs.handover import SPLIT
    from cleargs.run_results import open_prepared, open_run
    from cleargs.safe_io import read_json

    found = open_run(run)
    weights = found["rva"].weights() if "rva" in found.stages else None
    prepared = open_prepared(found["ingest"])
    sharper = None
    if deblurred:
        from cleargs.scene.viewer import SceneViewer
        from cleargs.scene.views import view_of

        trained = SceneViewer(run / scene_stage(installed(), run, None))
        views = {frame.frame_id: view_of(frame, prepared.folder, 1.0) for frame in prepared.frames}
        sharper = lambda number: trained.deblur(views[number])  # noqa: E731
    if folder.exists():
        raise InputError(f"{folder} exists already", hint="choose a new folder")
    with reporter.task("writing the capture"):
        made = prepared.to_nerfstudio(folder, weights, repeat=repeat, sharper=sharper)
    split = read_json(made / SPLIT)
    lines = [f"written: {made} ({len(split['train'])} frames for training, {len(split['test'])} held out)"]
    lines.append(f"nerfstudio: ns-train splatfacto --data {quote(str(made))}")
    every = split["test_every"]
    options = f"--data_dir {quote(str(made))} --data_factor 1 --test_every {every or 1_000_000}"
    lines.append(f"gsplat: python simple_trainer.py default {options}")
    answer(as_json, {"folder": str(made), **split}, *lines)
