"""``evidence``: make the page of results."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cleargs.cli.common import DONE_IN_PART, output_option, quiet_option, work_options
from cleargs.cli.progress_bars import make_reporter
from cleargs.evaluate.config import INSTALLABLE, LPIPS_NETS, EvalOptions
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.session import DeviceChoice, opened_store, resolve_device
from cleargs.pipeline.store import STORE_FOLDER

if TYPE_CHECKING:
    from benchmarks.comparison.evidence import EvidenceContext, SectionOutcome

RECIPE = "default"


@click.command(
    epilog="""\b
Examples:
  python -m benchmarks evidence -o evidence --quick                          a quick page, evidence/results.md
  python -m benchmarks evidence -o evidence --captures data --page docs/results.md
  python -m benchmarks evidence -o evidence --quick --section mixed          only one section
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
    type=click.Path(dir_okay=False, path_type=Path),
    help="File of the page; pictures go to results/ next to it.  [default: OUT/results.md]",
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
@work_options
@quiet_option
@click.pass_obj
def evidence(
    dag: Dag,
    out: Path,
    quick: bool,
    captures: Path | None,
    page: Path | None,
    sections: tuple[str, ...],
    listed: Path | None,
    dry_run: bool,
    device: DeviceChoice,
    threads: int,
    quiet: bool,
) -> int:
    """Make the captures, scenes, tables and pictures of the page of results.

    A fixed file lists the captures and variants. No default was chosen on these captures. Repeat the command
    to resume it. The page names missing results with the reason, for example a missing capture.
    """
    from benchmarks.comparison.evidence import (
        EvidenceContext,
        chosen_sections,
        estimate_minutes,
        make_section,
        read_evidence,
    )
    from benchmarks.comparison.origin import version_of_source
    from benchmarks.comparison.real import table_of, with_table
    from benchmarks.comparison.results_page import Origin, results_page
    from benchmarks.comparison.saved_sections import read_sections, save_section
    from benchmarks.comparison.scenes import SceneRecipe
    from cleargs.files import write_bytes

    lists = read_evidence(listed)
    chosen = chosen_sections(lists, quick=quick, names=sections)
    out = out.absolute()
    page = (page or out / "results.md").absolute()
    results = page.parent / "results"
    reporter = make_reporter(quiet)
    options = EvalOptions(lpips=LPIPS_NETS, scorers=INSTALLABLE)
    recipe = SceneRecipe(dag, RECIPE, (), resolve_device(device, reporter.info), threads, options)
    command = _command(quick=quick, captures=captures is not None, listed=listed is not None)
    origin = Origin(command, recipe.workflow, quick, chosen_sections(lists, quick=quick, names=()))
    version, machine = version_of_source(), f"{recipe.device}, threads: {recipe.threads}"
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
            kept = read_sections(results, origin.sections, reporter)
            text = results_page(kept, origin)
            if page.exists() and (real := table_of(page.read_text(encoding="utf-8"))):
                text = with_table(text, real)
            write_bytes(page, text.encode())
            complete = complete and not found.missing
    click.echo(f"written: {page}")
    return 0 if complete else DONE_IN_PART


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
    shown = [name for name in (cells.variants()[0], "rva", WHOLE) if name in labels]
    captures = {scene.sample.name: scene.sample.capture for scene in found.compared.scenes}
    comparison_sheet(folder / f"{found.section.name}-sheet.jpg", context.out, cells, labels, shown, captures)
