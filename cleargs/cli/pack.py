"""``cleargs pack``: a run as one file, without links."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

import click

from cleargs.cli.common import FILE, answer, json_option, quiet_option, run_argument
from cleargs.cli.progress_bars import make_reporter
from cleargs.errors import InputError
from cleargs.files import atomic_path
from cleargs.named_views import VIEWS
from cleargs.own_files import regular_files
from cleargs.packed import PACK, Pack, require_images
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.run_file import EVAL, RUN_FILE, SCENE, read_run_file
from cleargs.pipeline.stages import Stages
from cleargs.report.report_json import ENTRY, FOLDER, linked_manifests
from cleargs.report.single_file import for_others
from cleargs.run_results import scene_stage

KEPT = ("manifest.json", "world.json", "*.parquet", "colmap/**/*")
"""Files of every stage that go into the pack."""

MADE_OF_NAMES = re.compile(r'^(input = ").*/(.*")$|^store = .*\n', re.MULTILINE)
"""Lines of ``run.toml`` with paths of this machine: the input, whose file name is kept, and the store."""


@click.command(
    epilog="""\b
Examples:
  cleargs pack room                   writes room.zip
  cleargs pack room -o /tmp/for-anna.zip
  unzip room.zip && cleargs export room --for blender      on the other machine
"""
)
@run_argument
@click.option("-o", "--output", type=FILE, help="The new file (.zip).  [default: RUN.zip]")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@json_option
@quiet_option
@click.pass_obj
def pack(dag: Stages, run: Path, output: Path | None, force: bool, as_json: bool, quiet: bool) -> None:
    """Pack the files of RUN that its report and an export need into a ZIP file.

    These are the report, the last scene, the poses and the tables. The images, the earlier scenes and the
    candidates of repairs are left out, so a packed run cannot be continued.
    """
    read_run_file(run, dag)
    require_images(run, "packing it again")
    name = run.resolve().name or "run"
    output = output or Path(f"{name}.zip")
    if output.suffix.lower() != ".zip":
        raise InputError(f"{output} does not end in .zip", hint="name the file NAME.zip")
    check_outputs([output], dag, run, force=force)
    stage = scene_stage(dag, run, None)
    files = {file.relative_to(run).as_posix(): file for file in _files(run, dag)}
    results = [name for name in files if name.partition("/")[0] in dag.names]
    packed = Pack(scene=stage, files=(f"{stage}/{SCENE}", *sorted(results)))
    files |= {SCENE: run / stage / SCENE, PACK: run / RUN_FILE}  # PACK has the date of the settings
    with (
        atomic_path(output) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive,
        make_reporter(quiet).task(f"packing {name}", len(files)) as task,
    ):
        for inside, file in sorted(files.items()):
            content = file.read_bytes()
            if inside == PACK:
                content = json.dumps(packed.model_dump(), indent=2).encode()
            elif inside == RUN_FILE:
                content = MADE_OF_NAMES.sub(r"\1\2", content.decode()).encode()
            elif inside.endswith(".html"):
                page = for_others(content.decode(), run.resolve())
                content = page.replace(f"../{stage}/{SCENE}", f"../{SCENE}").encode()
            entry = zipfile.ZipInfo.from_file(file, f"{name}/{inside}", strict_timestamps=False)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content, zipfile.ZIP_DEFLATED)
            task.advance()
    size = output.stat().st_size
    answer(
        as_json,
        {"file": str(output), "files": len(files), "bytes": size},
        f"{output}: {len(files)} files, {size / 1e6:.1f} MB",
    )


def _files(run: Path, dag: Stages) -> Iterator[Path]:
    yield from (run / name for name in (RUN_FILE, ENTRY, VIEWS) if (run / name).is_file())
    for folder in (run / FOLDER, run / EVAL):
        yield from regular_files(folder)
    for stage in linked_manifests(run, dag.names):
        yield from (file for kept in KEPT for file in (run / stage).glob(kept) if file.is_file())
