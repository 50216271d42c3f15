"""``real``: real captures by the protocols of the literature, next to published figures."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.cli.common import DONE_IN_PART, output_option, quiet_option, work_options
from cleargs.cli.progress_bars import make_reporter
from cleargs.errors import InputError
from cleargs.evaluate.config import EvalOptions
from cleargs.pipeline.session import DeviceChoice, opened_store, resolve_device
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import STORE_FOLDER


@click.command(
    epilog="""\b
Examples:
  python -m benchmarks real -o real --captures data                        one seed, all scenes
  python -m benchmarks real -o real --captures data --seeds 3
  python -m benchmarks real -o real --rewrite --page docs/results.md --page docs/results/real.md
  python -m benchmarks real -o real --captures data --scenes blurball --variants full
"""
)
@output_option("Folder for runs, table and picture; resumes if it exists.", "out")
@click.option(
    "--captures",
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
    help="Variants to train. paper-open takes about as long as the other two together.",
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
    help="Also write the short table into this page, between <!-- real --> and <!-- /real -->, and the full "
    "one between <!-- real-full --> and <!-- /real-full -->; may be repeated.",
)
@click.option("--rewrite", is_flag=True, help="Train nothing: write the tables again, from OUT/real.json.")
@click.option(
    "--picture",
    type=click.Path(dir_okay=False, path_type=Path),
    help="File of the picture of blurball.  [default: OUT/blurball.jpg]",
)
@work_options
@quiet_option
@click.pass_obj
def real(
    dag: Stages,
    out: Path,
    captures: Path | None,
    seeds: int,
    scenes: str,
    variants: str,
    steps: int | None,
    overrides: tuple[str, ...],
    pages: tuple[Path, ...],
    rewrite: bool,
    picture: Path | None,
    device: DeviceChoice,
    threads: int,
    quiet: bool,
) -> int:
    """Train on real captures and compare with published figures.

    Writes OUT/real.md (the table), OUT/real.json (all figures) and a picture of blurball (a photograph, all
    frames alike, ClearGS, the reference). Repeat the command to resume it. Scenes and variants that
    an earlier call has measured stay in the tables, with their version. Missing captures are named.
    """
    from benchmarks.comparison.origin import version_of_source
    from benchmarks.comparison.real import (
        find_scenes,
        read_real_list,
        read_results,
        real_table,
        run_scenes,
        showcase,
        with_tables,
    )
    from benchmarks.comparison.scenes import SceneRecipe
    from benchmarks.comparison.variants import find_variants
    from cleargs.files import write_bytes

    listed, out = read_real_list(), out.absolute()
    results = read_results(out / "real.json")
    pictured = ""
    if rewrite and not results.scenes:
        raise InputError(f"{out}/real.json has no results", hint="run the command without --rewrite first")
    if not rewrite:
        if captures is None:
            raise click.UsageError("--captures DIR is missing")
        chosen = find_scenes(listed, _names(scenes))
        wanted = [variant.name for variant in find_variants(_names(variants))]
        reporter = make_reporter(quiet)
        options = EvalOptions(lpips=("alex",), scorers=())
        recipe = SceneRecipe(
            dag, "default", overrides, resolve_device(device, reporter.info), threads, options, steps
        )
        with opened_store(out / STORE_FOLDER) as store:
            found = run_scenes(out, captures, chosen, wanted, seeds, recipe, store, reporter)
        results = results.with_results(found, version_of_source())
        write_bytes(out / "real.json", results.model_dump_json(indent=1).encode())
        picture = picture or out / "blurball.jpg"
        pictured = f", {picture}" if showcase(picture, out, found) else ""
    table = real_table(listed, results)
    write_bytes(out / "real.md", f"{table}\n".encode())
    for page in pages:
        write_bytes(page, with_tables(page.read_text(encoding="utf-8"), listed, results).encode())
    click.echo(table)
    click.echo(f"written: {out}/real.md, {out}/real.json{pictured}")
    return DONE_IN_PART if results.failures else 0


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]
