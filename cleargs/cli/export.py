"""``cleargs export``: the scene as a file for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cleargs.cli.common import run_argument, stale_option
from cleargs.errors import InputError
from cleargs.files import disk_error
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.freshness import require_fresh
from cleargs.pipeline.manifest import linked_manifest

SCENE = "scene.ply"

FORMATS = ("ply",)
"""What can be written, by the ending of the file."""


@click.command(
    epilog="""\b
Examples:
  cleargs export room -o room.ply                  the world that all tables of the run share
  cleargs export room --world input -o room.ply    the world of the capture's own poses
"""
)
@run_argument
@click.option(
    "--format",
    "kind",
    type=click.Choice(FORMATS),
    help=f"What to write.  [default: by the ending of FILE: .{', .'.join(FORMATS)}]",
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
    "-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path), help="The new file."
)
@click.option("--force", is_flag=True, help="Replace FILE where it exists.")
@stale_option
@click.pass_obj
def export(
    dag: Dag,
    run: Path,
    kind: str | None,
    world: str,
    chosen: str | None,
    output: Path,
    force: bool,
    stale: bool,
) -> None:
    """Write the scene of RUN to a file."""
    if kind is None and output.suffix.lower().removeprefix(".") not in FORMATS:
        raise InputError(
            f"{output} has no ending that says what to write",
            hint=f"name it {output.with_suffix(f'.{FORMATS[0]}')}, or give --format {'|'.join(FORMATS)}",
        )
    if output.exists() and not force:
        raise InputError(f"{output} exists already", hint="choose another name, or give --force")
    done = [name for name in dag.names if (run / name / SCENE).is_file()]
    stage = done[-1] if done and chosen is None else chosen and dag.check(chosen)
    if stage is None:
        raise InputError(f"there is no scene in {run}", hint=f"see cleargs explain {run}")
    if stage not in done:
        there = f"the stages with a scene are {', '.join(done)}" if done else f"see cleargs explain {run}"
        raise InputError(f"{stage} has no scene in {run}", hint=there)
    warning = require_fresh(dag, run, (stage,), stale=stale)
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
    if warning:
        click.echo(warning)
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
