"""``cleargs export``: write the scene for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cleargs.cli.common import file_option, run_argument, scene_option
from cleargs.errors import InputError
from cleargs.files import disk_errors, write_json
from cleargs.manifest import linked_manifest
from cleargs.pipeline.dag import Dag
from cleargs.run_results import SCENE, scene_stage

MODEL = "colmap/sparse/0"


@click.command(
    epilog="""\b
Examples:
  cleargs export room -o room.ply                  in the normalised world of the run
  cleargs export room --world input -o room.ply    in the world of the capture's poses
  cleargs export room -o room.compressed.ply       a quarter of the size: SuperSplat, Spark, Brush
  cleargs export room -o room.spz                  a tenth of the size, as room.glb and room.usdc
  cleargs export room -o room.sog                  a tenth of the size, for SuperSplat and PlayCanvas
  cleargs export room -o room.ply --sh-degree 3    for the viewer of the Inria code
  cleargs export room -o room.ply --up z           for Blender; --up y for Spark and three.js
  cleargs export room -o room.sog --prune contribution:0.1 --crop percentile:98
"""
)
@run_argument
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
    help="Turn the scene so that this axis points up. The camera of the first frame is then at the origin "
    "and looks ahead. Use y for Spark and three.js, z for Blender.  [default: the axes of SuperSplat]",
)
@click.option(
    "--prune",
    "rules",
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
    "--spz-version",
    type=click.Choice(["3", "4"]),
    help="Version of a .spz file. 4 is newer; more programs read 3.  [default: 3]",
)
@scene_option
@file_option(".ply .compressed.ply .sog .spz .glb .usdc")
@click.option("--force", is_flag=True, help="Replace existing files.")
@click.pass_obj
def export(
    dag: Dag,
    run: Path,
    sh_degree: int | None,
    world: str,
    up: str | None,
    rules: tuple[str, ...],
    crop: str | None,
    spz_version: str | None,
    chosen: str | None,
    output: Path,
    force: bool,
) -> None:
    """Write the scene of RUN to a file.

    The cameras (FILE.cameras.json) and the COLMAP model (FILE.colmap) are written next to it.
    """
    from cleargs.cli.export_pruning import crop_scene, parse_crop, parse_prune, prune_scene
    from cleargs.splat.formats import check_options, format_of, padded, write_scene

    kind, version = format_of(output), None if spz_version is None else int(spz_version)
    check_options(kind, up=up, spz_version=version)
    if up is not None and world == "input":
        raise InputError("--up and --world input exclude each other", hint="give one of them")
    thresholds, region = parse_prune(rules), parse_crop(crop)
    stem = output.name[: -len(kind) - 1]
    cameras, model = output.with_name(f"{stem}.cameras.json"), output.with_name(f"{stem}.colmap")
    for file in (output, cameras, model):
        if file.exists() and not force:
            raise InputError(f"{file} exists already", hint="choose another name, or give --force")
    stage = scene_stage(dag, run, chosen)
    import numpy as np

    from cleargs.capture.cameras import Similarity
    from cleargs.capture.model import read_model, transform_model, write_model
    from cleargs.capture.tables import load_frames, load_points
    from cleargs.formation.frames import view_of
    from cleargs.splat.camera import cameras_json
    from cleargs.splat.ply import read_ply
    from cleargs.splat.transforms import far_offset, transform_scene

    ingest = run / dag.names[0]
    posed = [frame for frame in load_frames(ingest) if frame.registered]
    named = [(frame.name, view_of(frame, ingest, 0.0).camera) for frame in posed]
    similarity: dict[str, Any] = {}
    if world == "input":
        manifest = linked_manifest(run, ingest.name)
        world_of = Similarity.from_json(manifest and manifest.summary.get("similarity"), ingest)
        similarity = {
            "scale": world_of.scale,
            "rotation": world_of.rotation.T,
            "translation": world_of.origin,
        }
    elif up is not None:
        from cleargs.splat.transforms import orient_up

        similarity = orient_up(named[0][1], up)

    scene = read_ply(run / stage / SCENE)
    messages = []
    if thresholds:
        scene, message = prune_scene(scene, thresholds, run, stage)
        messages.append(message)
    if sh_degree is not None:
        scene = padded(scene, sh_degree)
    if world == "input" and (offset := far_offset(scene.gaussians, similarity)):
        similarity["translation"] = similarity["translation"] - np.array(offset)
        file = output.with_name(f"{stem}.offset.json")
        write_json(file, {"definition": "x_input = x_file + offset", "offset": offset})
        messages.append(
            "single precision would round positions so far from the origin: the files are written without "
            f"the offset {offset}, which is in {file}"
        )
    if similarity:
        scene = transform_scene(scene, **similarity)
    if region is not None:
        scene, message = crop_scene(scene, region)
        messages.append(message)
    if kind == "ply" and 0 < (degree := scene.gaussians.sh_degree) < 3:
        messages.append(
            f"spherical harmonics of degree {degree}: for viewers of degree 3 only, --sh-degree 3"
        )
    if scene.gaussians.num == 0:
        raise InputError("no Gaussian is left", hint="prune or crop less")
    with disk_errors(output):
        output.parent.mkdir(parents=True, exist_ok=True)
    write_scene(output, scene, kind, turned=up is not None, spz_version=version)
    write_json(cameras, cameras_json(named, **similarity))
    sparse = read_model(ingest / MODEL)
    write_model(
        model / "sparse" / "0",
        transform_model(sparse, **similarity) if similarity else sparse,
        load_points(ingest).rgb,
    )
    for message in messages:
        click.echo(message)
    axes = f"{up} is up" if up is not None else f"{world} world"
    click.echo(f"{output}: scene of {stage}, {scene.gaussians.num} Gaussians, {axes}")
