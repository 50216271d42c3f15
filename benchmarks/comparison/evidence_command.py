"""``evidence``: make the tables of the results."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cleargs.cli.common import DONE_IN_PART, output_option, quiet_option, work_options
from cleargs.cli.progress_bars import make_reporter
from cleargs.evaluate.config import INSTALLABLE, LPIPS_NETS, EvalOptions
from cleargs.pipeline.session import DeviceChoice, opened_store, resolve_device
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import STORE_FOLDER

if TYPE_CHECKING:
    from benchmarks.comparison.evidence import EvidenceContext, SectionOutcome
    from benchmarks.comparison.results_page import Origin
    from cleargs.progress import Reporter

RECIPE = "default"


@click.command(
    epilog="""\b
Examples:
  python -m benchmarks evidence -o evidence --quick                   quick pages, evidence/results/all.md
  python -m benchmarks evidence -o evidence --captures data --page docs/results.md
  python -m benchmarks evidence -o evidence --quick --section mixed   only one section
"""
)
@output_option("Folder for captures, runs and tables; resumes if it exists.", "out")
@click.option("--quick", is_flag=True, help="Make a quick page: fewer and smaller captures, short trainings.")
@click.option(
    "--captures",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder with the real captures, named as in the list. Without it, the page lists them as missing.",
)
@click.option(
    "--page",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Front page, whose table of faults is replaced; all other pages go to results/ next to it.  "
    "[default: no front page, and OUT/results]",
)
@click.option(
    "--section", "sections", multiple=True, metavar="NAME", help="Make only this section; may be repeated."
)
@click.option(
    "--list",
    "listed",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="List of evidence (TOML) to use instead of the fixed one.",
)
@click.option("--dry-run", is_flag=True, help="Print the plan and stop.")
@click.option("--rewrite", is_flag=True, help="Only write the pages again, from the stored results.")
@work_options
@quiet_option
@click.pass_obj
def evidence(
    dag: Stages,
    out: Path,
    quick: bool,
    captures: Path | None,
    page: Path | None,
    sections: tuple[str, ...],
    listed: Path | None,
    dry_run: bool,
    rewrite: bool,
    device: DeviceChoice,
    threads: int,
    quiet: bool,
) -> int:
    """Make the captures, scenes, tables and pictures of the pages of results.

    A fixed file lists the captures and variants. No default was chosen on these captures. Repeat the command
    to resume it. The pages name missing results with the reason, for example a missing capture.
    """
    from benchmarks.comparison.evidence import (
        EvidenceContext,
        chosen_sections,
        estimate_minutes,
        make_section,
        read_evidence,
    )
    from benchmarks.comparison.origin import version_of_source
    from benchmarks.comparison.results_page import Origin
    from benchmarks.comparison.saved_sections import save_section
    from benchmarks.comparison.scenes import SceneRecipe

    lists = read_evidence(listed)
    chosen = chosen_sections(lists, quick=quick, names=sections)
    out = out.absolute()
    results = (page.absolute().parent if page else out) / "results"
    reporter = make_reporter(quiet)
    options = EvalOptions(lpips=LPIPS_NETS, scorers=INSTALLABLE)
    recipe = SceneRecipe(dag, RECIPE, (), resolve_device(device, reporter.info), threads, options)
    command = _command(quick=quick, captures=captures is not None, listed=listed is not None)
    origin = Origin(command, recipe.workflow, quick, chosen_sections(lists, quick=quick, names=()))
    version, machine = version_of_source(), f"{recipe.device}, threads: {recipe.threads}"
    if rewrite:
        _write_pages(results, page, origin, reporter)
        return 0
    complete = True
    with opened_store(out / STORE_FOLDER) as store:
        context = EvidenceContext(out, captures.absolute() if captures else None, recipe, store, reporter)
        plan = list(zip(chosen, estimate_minutes(chosen, context), strict=True))
        for section, cost in plan:
            click.echo(f"{section.name:12} {cost:6.1f} min  {section.title}")
        click.echo(f"{'total':12} {sum(cost for _, cost in plan):6.1f} min  on two idle cores")
        if dry_run:
            return 0
        for section, _ in plan:
            started = time.monotonic()
            found = make_section(section, context)
            reporter.info(f"section {section.name}: {(time.monotonic() - started) / 60:.1f} min")
            _write_pictures(found, context, results)
            save_section(results, found, version, machine)
            _write_pages(results, page, origin, reporter)
            complete = complete and not found.missing
    return 0 if complete else DONE_IN_PART


def _write_pages(results: Path, page: Path | None, origin: Origin, reporter: Reporter) -> None:
    """Write the pages of the stored sections to ``results``, and the table of faults into ``page``."""
    from benchmarks.comparison.front_page import fault_rows, fault_table, plot_gains, with_block
    from benchmarks.comparison.results_page import section_page, summary_page
    from benchmarks.comparison.saved_sections import read_sections
    from cleargs.files import write_bytes

    kept = read_sections(results, origin.sections, reporter)
    results.mkdir(parents=True, exist_ok=True)
    write_bytes(results / "all.md", summary_page(kept, origin).encode())
    for saved in kept:
        write_bytes(results / f"{saved.section.name}.md", section_page(saved, origin).encode())
    if page and (rows := fault_rows(kept)):
        text = with_block(page.read_text(encoding="utf-8"), "faults", fault_table(kept))
        write_bytes(page, text.encode())
        plot_gains(results / "gains.png", rows)
    click.echo(f"written: {results / 'all.md'}")


def _command(*, quick: bool, captures: bool, listed: bool) -> str:
    """Return the command with placeholders for folders and files."""
    words = [
        "python -m benchmarks evidence -o OUT",
        "--quick" * quick,
        "--captures DIR" * captures,
        "--list FILE" * listed,
    ]
    return " ".join(word for word in words if word)


def _write_pictures(found: SectionOutcome, context: EvidenceContext, folder: Path) -> None:
    from benchmarks.comparison.pictures import comparison_sheet, plot_comparison
    from benchmarks.comparison.variants import WHOLE

    if found.compared is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    cells, labels = found.compared.results.cells, found.compared.labels
    plot_comparison(folder / f"{found.section.name}.png", cells, labels)
    if found.section.kind != "rooms":
        return  # the terms of most real captures do not allow to show them
    shown = [name for name in (cells.variants()[0], "rva", WHOLE) if name in labels]
    captures = {scene.sample.name: scene.sample.capture for scene in found.compared.scenes}
    comparison_sheet(folder / f"{found.section.name}-sheet.jpg", context.out, cells, labels, shown, captures)
