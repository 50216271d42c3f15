"""``cleargs demo``: make a small synthetic capture and run it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from cleargs.cli.common import (
    open_option,
    output_option,
    quality_option,
    quiet_option,
    store_option,
    work_options,
)
from cleargs.cli.progress_bars import make_reporter
from cleargs.cli.run import run
from cleargs.errors import InputError


@click.command()
@output_option("Folder of the demo.", "folder", required=False)
@open_option("Open the report in the browser at the end.")
@quality_option
@work_options
@store_option
@quiet_option
@click.pass_context
def demo(
    context: click.Context, /, folder: Path | None, opens: bool, quality: str | None, **options: Any
) -> int:
    """Make a synthetic capture of 16 frames in the folder demo, and turn it into a scene: a few minutes.

    The capture is demo/capture, and the run is demo/run. The same command again resumes.
    """
    from cleargs.synth.synthetic_capture import make_capture

    place = folder or Path("demo")
    capture = place / "capture"
    if not (capture / "transforms.json").is_file():
        if place.is_dir() and any(place.iterdir()):  # it may be a capture of the user
            raise InputError(f"{place} is not empty, and holds no demo", hint="choose a new folder with -o")
        reporter = make_reporter(options["quiet"])
        place.mkdir(parents=True, exist_ok=True)
        make_capture(capture, "mixed", frames=16, width=480, height=270, seed=0, reporter=reporter)
    given = {"recipe": "smoke", "overrides": ("ingest.poses=sfm",), "quality": quality}
    return int(context.invoke(run, source=capture, folder=place / "run", opens=opens, **given, **options))
