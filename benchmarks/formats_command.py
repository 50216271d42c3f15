"""The command ``python -m benchmarks formats``."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import click

SCALES = (0.001, 0.01, 1.0, 100.0, 1000.0)
"""Sizes of the world, in that of the run."""
PACKAGES = Path(".oracles/node_modules")
_GLTF = """
const {readFileSync} = require('fs');
const isFault = ({message, pointer, severity}) =>
    severity < 2 && !(message + pointer).includes('KHR_gaussian_splatting'); // the validator does not know it
require('gltf-validator').validateBytes(new Uint8Array(readFileSync(process.argv[1])))
    .then(({issues}) => process.exit(issues.messages.filter(isFault).length));
"""


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
def formats(runs: Sequence[Path]) -> None:
    """Print what each format of ``cleargs export`` loses of the scenes of RUNS, in worlds of several sizes.

    The loss is the change of PSNR, in dB, on the training frames. The validators of OpenUSD and of glTF
    (`make oracles`) check the files.
    """
    import numpy as np

    from cleargs.capture.tables import load_frames
    from cleargs.errors import InputError
    from cleargs.parquet import read_table
    from cleargs.pipeline.stages import installed
    from cleargs.render.pruning import training_psnr
    from cleargs.run_results import scene_path, scene_stage
    from cleargs.rva.tables import FRAMES
    from cleargs.scene.views import real_views
    from cleargs.splat.formats import FORMATS, read_scene, write_scene
    from cleargs.splat.ply import read_ply
    from cleargs.splat.transforms import transform_scene

    click.echo("scene,format,scale,MB,dB,faults")
    for run in runs:
        stage = scene_stage(installed(), run, None)
        scene = read_ply(scene_path(run, stage))
        allocation = read_table(run / "rva/frames.parquet", FRAMES).to_pylist()
        weights = {row["frame_id"]: row["weight"] for row in allocation}
        views = real_views(load_frames(run / "ingest"), weights, run / "ingest")
        centres = np.stack([view.camera.centre for view in views])
        best = training_psnr(scene, views, run / stage)
        for kind in FORMATS:
            for scale in SCALES:
                still = {"rotation": np.eye(3), "translation": np.zeros(3)}
                made = transform_scene(scene, scale=scale, **still)
                with tempfile.TemporaryDirectory() as folder:
                    file = Path(folder) / f"scene.{kind}"
                    try:
                        write_scene(file, made, kind, eyes=scale * centres)
                    except InputError as refusal:
                        click.echo(f"{run.name},{kind},{scale:g},,refused,{refusal}")
                        continue
                    back = transform_scene(read_scene(file), scale=1 / scale, **still)
                    loss = training_psnr(back, views, run / stage) - best
                    size = file.stat().st_size / 1e6
                    click.echo(f"{run.name},{kind},{scale:g},{size:.2f},{loss:+.3f},{_faults(file)}")


def _faults(file: Path) -> int | str:
    """Return the number of errors that the validator of the format finds, or "" without one."""
    if file.suffix == ".usdc":
        from pxr import Usd, UsdValidation

        every = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
        return len(UsdValidation.ValidationContext(every).Validate(Usd.Stage.Open(str(file))))
    if file.suffix == ".glb" and PACKAGES.is_dir():
        return subprocess.run(["node", "-e", _GLTF, str(file)], cwd=PACKAGES, check=False).returncode
    return ""
