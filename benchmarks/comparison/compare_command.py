"""``compare``: tables and pictures of variants, captures or runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from benchmarks.comparison.variants import BASELINES, VARIANTS, find_variants
from cleargs.cli.common import (
    DONE_IN_PART,
    json_option,
    output_option,
    print_json,
    quality_option,
    quiet_option,
    report_option,
    with_shortcuts,
    work_options,
)
from cleargs.cli.progress_bars import make_reporter
from cleargs.errors import CleargsError, InputError
from cleargs.evaluate.config import LPIPS_NETS, SCORERS, EvalOptions, LpipsNet
from cleargs.pipeline.run_file import RUN_FILE
from cleargs.pipeline.session import DeviceChoice, opened_store, resolve_device
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import STORE_FOLDER

if TYPE_CHECKING:
    from benchmarks.comparison.scenes import FinishedScene, SceneRecipe
    from benchmarks.comparison.variants import Variant


TRAINING_OPTIONS = {
    "variants": "--variants",
    "seeds": "--seeds",
    "steps": "--steps",
    "workflow": "--workflow",
    "overrides": "--set",
    "quality": "--quality",
}
"""Options that only apply to training: parameter -> name on the command line."""


def _seeds(context: click.Context, parameter: click.Parameter, value: str) -> tuple[int, ...]:
    try:
        seeds = tuple(dict.fromkeys(int(part) for part in value.split(",")))
    except ValueError:
        seeds = ()
    if not seeds or min(seeds) < 0:
        raise click.BadParameter("give whole numbers from 0, separated by commas, e.g. 0,1,2")
    return seeds


def _nets(context: click.Context, parameter: click.Parameter, value: str) -> tuple[LpipsNet, ...]:
    if value in ("both", "none"):
        return LPIPS_NETS if value == "both" else ()
    wanted = [part.strip() for part in value.split(",")]
    nets = tuple(net for net in LPIPS_NETS if net in wanted)
    if len(nets) != len(wanted):
        raise click.BadParameter(f"choose among {', '.join(LPIPS_NETS)}, both and none")
    return nets


@click.command(
    epilog="""\b
Examples:
  python -m benchmarks compare data/mixed -o table                     all variants of one capture
  python -m benchmarks compare data/mixed-* data/sharp -o table         several captures, grouped by protocol
  python -m benchmarks compare data/mixed -o table --variants all-view,rva --seeds 0,1,2
  python -m benchmarks compare data/kitchen -o table --set ingest.holdout=sharpest:8
  python -m benchmarks compare runs/a runs/b -o table                  runs that exist already
  table/report/index.html                                 the page to look at
"""
)
@click.argument("sources", metavar="CAPTURE|RUN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@output_option("Folder of the runs, tables, pictures and report; resumes if it exists.", "out")
@click.option(
    "--variants",
    default="",
    metavar="NAME,...",
    help=f"Variants to train: {', '.join(variant.name for variant in VARIANTS)}.  [default: all]",
)
@click.option(
    "--seeds", default="0", show_default=True, callback=_seeds, help="Training seeds for each capture."
)
@click.option(
    "--steps",
    type=click.IntRange(min=1),
    help="Total training steps of each variant, in the recipe's proportions.  [default: those of the recipe]",
)
@click.option(
    "--reference",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Sharp images to compare with.  [default: CAPTURE/truth, else the held-out frames]",
)
@click.option("--lpips", default="alex,vgg", show_default=True, callback=_nets, help="Networks of LPIPS.")
@click.option(
    "--workflow", default="default", show_default=True, metavar="NAME|FILE.toml", help="The recipe."
)
@click.option("--set", "overrides", multiple=True, metavar="STAGE.FIELD=VALUE", help="Change one setting.")
@quality_option
@report_option("Write OUT/report/index.html, a page with the tables and pictures.")
@work_options
@json_option
@quiet_option
@click.pass_obj
def compare(
    dag: Stages,
    sources: tuple[Path, ...],
    out: Path,
    variants: str,
    seeds: tuple[int, ...],
    steps: int | None,
    reference: Path | None,
    lpips: tuple[LpipsNet, ...],
    workflow: str,
    overrides: tuple[str, ...],
    quality: str | None,
    wants_report: bool,
    device: DeviceChoice,
    threads: int,
    as_json: bool,
    quiet: bool,
) -> int:
    """Train variants of the method on captures, or compare finished runs, and print the paper's tables.

    All variants of a capture train for the same number of steps, with the same budget of Gaussians and the
    same SH degree. Captures of one protocol are samples of one column. With several samples, a difference
    whose 95 % interval includes 0 is shown as "none". Variants share the results of equal stages. Repeat the
    command to resume it.
    """
    from benchmarks.comparison.findings import compare_scenes
    from benchmarks.comparison.pictures import comparison_sheet, plot_comparison
    from benchmarks.comparison.scenes import Sample, SceneRecipe, make_scenes, scene_of_run
    from benchmarks.comparison.tables import markdown, training_lines
    from cleargs.files import write_bytes, write_json

    runs = [source for source in sources if (source / RUN_FILE).is_file()]
    if runs and len(runs) != len(sources):
        raise InputError("some of these are runs and some captures", hint="give only runs or only captures")
    for source in sources:
        if not source.exists():
            raise InputError(f"{source} does not exist", hint="give captures or run folders")
    if runs and (idle := _given(TRAINING_OPTIONS)):
        raise InputError(
            f"{', '.join(idle)} cannot change finished runs",
            hint="leave it out, or give captures to train on",
        )
    chosen = find_variants([name.strip() for name in variants.split(",") if name.strip()])
    out = out.absolute()
    reporter = make_reporter(quiet)
    options = EvalOptions(lpips=lpips, scorers=SCORERS)
    place = resolve_device(device, reporter.info)
    settings = with_shortcuts(overrides, {"quality": quality})
    recipe = SceneRecipe(dag, workflow, settings, place, threads, options, steps)
    with opened_store(out / STORE_FOLDER) as store:
        if runs:
            _check_names([run.resolve().name for run in runs], "runs")
            finished = [scene_of_run(run, dag, reference) for run in runs]
            # A sample is named after its capture, so two captures with one name would be paired.
            sources_of_runs = {scene.sample.capture.resolve() for scene in finished}
            _check_names([source.name for source in sources_of_runs], "captures of these runs")
            made: Iterator[FinishedScene | str] = iter(finished)
        else:
            samples = [Sample(source.absolute(), seed, reference) for source in sources for seed in seeds]
            _check_names([source.resolve().name for source in sources], "captures")
            made = make_scenes(out, samples, chosen, recipe, store, reporter)
        compared = compare_scenes(out, made, recipe, store, reporter)
    found, labels = compared.results.cells, compared.labels
    warnings = training_lines(found, labels)
    baselines = BASELINES if not runs else found.variants()[:1]
    made_with = _made_with(() if runs else chosen, seeds, recipe)
    head = "\n\n".join(["# Comparison", *warnings, "\n".join(f"* {line}" for line in made_with)])
    text = f"{head}\n\n" + markdown(compared.results, labels, baselines)
    write_bytes(out / "comparison.md", text.encode())
    document = compared.document()
    write_json(out / "comparison.json", document)
    plot_comparison(out / "comparison.png", found, labels)
    shown = (found.variants()[0], *(name for name in ("rva", "full") if name in labels))
    captures = {scene.sample.name: scene.sample.capture for scene in compared.scenes}
    comparison_sheet(out / "sheet.png", out, found, labels, shown, captures)
    page = None
    if wants_report:
        from benchmarks.comparison.page import write_comparison

        try:
            page = write_comparison(out, compared, baselines, made_with, warnings)
        except CleargsError as error:  # the comparison itself has succeeded
            reporter.warn(f"the report could not be written: {error}; {error.hint}")
    if as_json:
        print_json(document)
    else:
        click.echo(text)
        if page is not None:
            click.echo(f"report: {page}")
        click.echo(f"written: {out}/comparison.md, comparison.json, comparison.png, sheet.png")
    return DONE_IN_PART if compared.failures else 0


def _made_with(variants: Sequence[Variant], seeds: Sequence[int], recipe: SceneRecipe) -> list[str]:
    """Return lines that describe the settings and versions behind the tables."""
    from cleargs.manifest import versions

    lines = [f"LPIPS v0.1 with {', '.join(recipe.options.lpips) or 'no network'}; device {recipe.device}"]
    if variants:
        settings = "".join(f" --set {override}" for override in recipe.overrides)
        steps = f"{recipe.steps or 'as many as the whole method'}"
        lines.append(
            f"recipe {recipe.workflow}{settings}; seeds {', '.join(map(str, seeds))}; steps: {steps}"
        )
        lines += [f"{variant.label}: {_settings(variant)}" for variant in variants]
    return [*lines, ", ".join(f"{name} {version}" for name, version in versions().items())]


def _settings(variant: Variant) -> str:
    recipe = "the recipe" if variant.workflow is None else f"the recipe {variant.workflow}"
    return f"{', '.join((recipe, *variant.overrides))}; the scene of {variant.stage}"


def _given(options: Mapping[str, str]) -> list[str]:
    """Return the names of those ``options`` (parameter -> name) that were given on the command line."""
    source = click.get_current_context().get_parameter_source
    return [text for name, text in options.items() if source(name) is ParameterSource.COMMANDLINE]


def _check_names(names: Sequence[str], what: str) -> None:
    """Raise InputError for equal names: captures would share a run folder, and runs a row of the tables."""
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            f"two {what} have the name {twice[0]}", hint=f"give the {what} distinct folder names"
        )
