"""``cleargs export``: the scene as a file for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cleargs.cli.common import SCENE, run_argument, scene_stage, stale_option
from cleargs.errors import InputError
from cleargs.files import disk_error
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.freshness import require_fresh
from cleargs.pipeline.manifest import linked_manifest


@click.command(
    epilog="""\b
Examples:
  cleargs export room -o room.ply                  the world that all tables of the run share
  cleargs export room --world input -o room.ply    the world of the capture's own poses
  cleargs export room -o room.compressed.ply       a quarter of the size: SuperSplat, Spark, Brush
  cleargs export room -o room.spz                  a tenth of the size; room.glb and room.usdc as well
  cleargs export room -o room.ply --sh-degree 3    for the viewer of the Inria code
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
    help="input: undo the normalisation, so that the scene fits the capture's own poses.",
)
@click.option("--stage", "chosen", help="The stage whose scene to take.  [default: the last that is done]")
@click.option(
    "-o",
    "--output",
    required=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="The new file; its ending says what to write: .ply .compressed.ply .spz .glb .usdc",
)
@click.option("--force", is_flag=True, help="Replace the file where it exists.")
@stale_option
@click.pass_obj
def export(
    dag: Dag,
    run: Path,
    sh_degree: int | None,
    world: str,
    chosen: str | None,
    output: Path,
    force: bool,
    stale: bool,
) -> None:
    """Write the scene of RUN to a file, its cameras beside it (FILE.cameras.json)."""
    from cleargs.splat.formats import format_of, padded, write_scene

    kind = format_of(output)
    cameras = output.with_name(f"{output.name[: -len(kind) - 1]}.cameras.json")
    for file in (output, cameras):
        if file.exists() and not force:
            raise InputError(f"{file} exists already", hint="choose another name, or give --force")
    stage = scene_stage(dag, run, chosen)
    warning = require_fresh(dag, run, (stage,), stale=stale)
    similarity = _similarity(run, dag.names[0]) if world == "input" else {}
    from cleargs.capture.tables import load_frames
    from cleargs.files import write_json
    from cleargs.splat.cameras_json import cameras_json
    from cleargs.splat.export import transform_scene
    from cleargs.splat.ply import read_ply
    from cleargs.splat.views import view_of

    scene = read_ply(run / stage / SCENE)
    if sh_degree is not None:
        scene = padded(scene, sh_degree)
    if similarity:
        scene = transform_scene(scene, **similarity)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(error, output) from error
    write_scene(output, scene, kind)
    ingest = run / dag.names[0]
    posed = [frame for frame in load_frames(ingest) if frame.registered]
    named = [(frame.name, view_of(frame, ingest, 0.0).camera) for frame in posed]
    write_json(cameras, cameras_json(named, **similarity))
    if warning:
        click.echo(warning)
    click.echo(f"{output}: the scene of {stage}, {scene.gaussians.num} Gaussians, {world} world")


def _similarity(run: Path, first: str) -> dict[str, Any]:
    """The similarity from the normalised world back to the input's, as the first stage noted it: scale,
    rotation [3, 3], translation [3]."""
    manifest = linked_manifest(run, first)
    found = manifest.summary.get("similarity") if manifest is not None else None
    if not isinstance(found, dict):
        raise InputError(
            f"{run / first} does not say how it was normalised", hint="run that stage with --force"
        )
    import numpy as np

    return {
        "scale": float(found["scale"]),
        "rotation": np.array(found["rotation"], dtype=np.float64),
        "translation": np.array(found["translation"], dtype=np.float64),
    }
