"""``cleargs export``: the scene as a file for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import click

from cleargs.cli.common import run_argument
from cleargs.errors import InputError
from cleargs.files import disk_error
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.manifest import linked_manifest

SCENE = "scene.ply"


@click.command(
    epilog="""\b
Examples:
  cleargs export room -o room.ply                  the world that all tables of the run share
  cleargs export room --world input -o room.ply    the world of the capture's own poses
"""
)
@run_argument
@click.option("--format", "kind", type=click.Choice(["ply"]), default="ply", show_default=True)
@click.option(
    "--world",
    type=click.Choice(["normalised", "input"]),
    default="normalised",
    show_default=True,
    help="input: undo the normalisation, so that the scene fits the capture's own poses.",
)
@click.option("--stage", "chosen", help="The stage whose scene to take.  [default: the last that is done]")
@click.option(
    "-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path), help="The new file."
)
@click.pass_obj
def export(dag: Dag, run: Path, kind: Literal["ply"], world: str, chosen: str | None, output: Path) -> None:
    """Write the scene of RUN to a file."""
    names = dag.names[::-1] if chosen is None else (dag.check(chosen),)
    stage = next((name for name in names if (run / name / SCENE).is_file()), None)
    if stage is None:
        raise InputError(f"there is no scene in {run}", hint=f"see cleargs explain {run}")
    similarity = _similarity(run, dag.names[0]) if world == "input" else None
    from cleargs.splat.ply import read_ply, write_ply

    scene = read_ply(run / stage / SCENE)
    if similarity is not None:
        import numpy as np

        from cleargs.splat.export import transform_scene

        scene = transform_scene(
            scene,
            scale=float(similarity["scale"]),
            rotation=np.array(similarity["rotation"], dtype=np.float64),
            translation=np.array(similarity["translation"], dtype=np.float64),
        )
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(error, output) from error
    write_ply(output, scene)
    click.echo(f"{output}: the scene of {stage}, {scene.gaussians.num} Gaussians, {world} world")


def _similarity(run: Path, first: str) -> dict[str, Any]:
    """The similarity from the normalised world back to the input's, as the first stage noted it."""
    manifest = linked_manifest(run, first)
    found = manifest.summary.get("similarity") if manifest is not None else None
    if not isinstance(found, dict):
        raise InputError(
            f"{run / first} does not say how it was normalised", hint="run that stage with --force"
        )
    return found
