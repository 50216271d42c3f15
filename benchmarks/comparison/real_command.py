"""``real``: real captures by the protocols of the literature, next to published figures."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.cli.common import DONE_IN_PART, output_option, quiet_option, work_options
from cleargs.cli.progress_bars import make_reporter
from cleargs.evaluate.config import EvalOptions
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.session import DeviceChoice, opened_store, resolve_device
from cleargs.pipeline.store import STORE_FOLDER


@click.command(
    epilog="""\b
Examples:
  python -m benchmarks real -o real --captures data                        one seed, all scenes
  python -m benchmarks real -o real --captures data --seeds 3 --page README.md --page docs/results.md
  python -m benchmarks real -o real --captures data --scenes blurball --variants full
"""
)
@output_option("Folder for runs, table and picture; resumes if it exists.", "out")
@click.option(
    "--captures",
    required=True,
    envvar="CLEARGS_CAPTURES",
    show_envvar=True,
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder with the captures, named as in benchmarks/comparison/real.toml.",
)
@click.option(
    "--seeds", default=1, show_default=True, type=click.IntRange(1, 20), help="Number of trainings."
)
@click.option("--scenes", default="", metavar="NAME,...", help="Scenes to run.  [default: all]")
@click.option(
    "--variants",
    default="all-view,full,paper-open",
    show_default=True,
    metavar="NAME,...",
    help="Variants to train. Without paper-open it takes about a third of the time.",
)
@click.option(
    "--steps", type=click.IntRange(min=1), help="Training steps of every scene, to try the command."
)
@click.option("--set", "overrides", multiple=True, metavar="STAGE.FIELD=VALUE", help="Change one setting.")
@click.option(
    "--page",
    "pages",
    multiple=True,
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Also write the table into this page, between <!-- real --> and <!-- /real -->; may be repeated.",
)
@click.option(
    "--picture",
    type=click.Path(dir_okay=False, path_type=Path),
    help="File of the picture of blurball.  [default: OUT/blurball.jpg]",
)
@work_options
@quiet_option
@click.pass_obj
def real(
    dag: Dag,
    out: Path,
    captures: Path,
    seeds: int,
    scenes: str,
    variants: str,
    steps: int | None,
    overrides: tuple[str, ...],
    pages: tuple[Path, ...],
    picture: Path | None,
    device: DeviceChoice,
    threads: int,
    quiet: bool,
) -> int:
    """Train on real captures and compare with published figures.

    Writes OUT/real.md (the table), OUT/real.json (all figures) and a picture of blurball (a photograph, all
    frames alike, ClearGS, the reference). Repeat the command to resume it. Missing captures are named.
    """
    from benchmarks.comparison.origin import version_of_source
    from benchmarks.comparison.real import (
        find_scenes,
        read_real_list,
        real_table,
        run_scenes,
        showcase,
        with_table,
    )
    from benchmarks.comparison.scenes import SceneRecipe
    from benchmarks.comparison.variants import find_variants
    from cleargs.files import write_bytes, write_json

    listed, out = read_real_list(), out.absolute()
    chosen = find_scenes(listed, _names(scenes))
    wanted = [variant.name for variant in find_variants(_names(variants))]
    reporter = make_reporter(quiet)
    options = EvalOptions(lpips=("alex",), scorers=())
    recipe = SceneRecipe(
        dag, "default", overrides, resolve_device(device, reporter.info), threads, options, steps
    )
    with opened_store(out / STORE_FOLDER) as store:
        found = run_scenes(out, captures, chosen, wanted, seeds, recipe, store, reporter)
    command = f"python -m benchmarks real -o OUT --captures DIR --seeds {seeds}"
    table = f"{real_table(listed, found)}\n\n`{command}`, version {version_of_source()}"
    write_json(out / "real.json", found.document())
    write_bytes(out / "real.md", f"{table}\n".encode())
    for page in pages:
        write_bytes(page, with_table(page.read_text(encoding="utf-8"), table).encode())
    click.echo(table)
    picture = picture or out / "blurball.jpg"
    pictured = f", {picture}" if showcase(picture, out, found) else ""
    click.echo(f"written: {out}/real.md, {out}/real.json{pictured}")
    return DONE_IN_PART if found.failures else 0


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]
