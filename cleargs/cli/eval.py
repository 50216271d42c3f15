"""``cleargs eval``: metrics of a run's scenes, a scene file, or any method's images, against sharp images."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from cleargs.cli.common import (
    fail_below_option,
    json_option,
    print_json,
    quiet_option,
    report_below,
    threads_option,
)
from cleargs.cli.progress_bars import make_reporter
from cleargs.digest import file_digest
from cleargs.errors import InputError
from cleargs.evaluate.config import LPIPS_NETS, SCORERS, EvalOptions, LpipsNet
from cleargs.manifest import has_results
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.run_file import RUN_FILE, check_links
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import visible_names
from cleargs.run_results import check_results, scene_path, scene_stage

if TYPE_CHECKING:
    from cleargs.evaluate.eval_report import Evaluation, Report

_LABELS = {
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips_alex": "LPIPS\nalex",
    "lpips_vgg": "LPIPS\nvgg",
    "clarity-net": "clarity\n-net",
    "naturalness-stats": "naturalness\n-stats",
    "musiq": "MUSIQ",
    "clip-iqa": "CLIP-\nIQA",
}
EXPOSURES_DIFFER = 0.5
"""Gain of PSNR by aligned colours, dB, above which the gain is printed."""
SMALLEST_SHARE = 5e-4
"""Least share of the pixels in a region whose PSNR is printed. That of fewer says nothing."""

OPAQUE_DB = 45
"""PSNR between a scene over two backgrounds, dB, above which the background is not visible."""

_DIGITS = {"psnr": 2, "ssim": 4, "lpips_alex": 4, "lpips_vgg": 4}


def _scorers(context: click.Context, parameter: click.Parameter, value: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(part.strip() for part in value.split(",") if part.strip()))
    return () if names == ("none",) else names


@click.command(
    epilog="""\b
Examples:
  cleargs eval room --reference capture/truth/observed     the last scene, at the frames' poses
  cleargs eval room --reference capture/truth/novel --stage all
  cleargs eval room                                        on the frames held out (ingest.holdout)
  cleargs eval scene.ply --reference DIR --json            a scene file of any program, in the world of DIR
  cleargs eval --renders DIFIX --reference DIR -o difix.json

\b
DIR holds images/ and transforms.json in the world of the capture. The result of a run is written into
RUN/eval/NAME/eval.json (NAME: the folder's name, or holdout) with eval.parquet next to it. Results of other
stages and options stay there as long as their scenes do.
"""
)
@click.argument("target", required=False, metavar="[RUN|SCENE]", type=click.Path(path_type=Path))
@click.option(
    "--reference",
    "directory",
    type=click.Path(path_type=Path),
    help="Folder of sharp images and poses.  [default: the frames that RUN held out]",
)
@click.option(
    "--renders",
    type=click.Path(path_type=Path),
    help="Evaluate the images in this folder, matched by stem, instead of a scene.",
)
@click.option(
    "--stage", "stages", multiple=True, help="Stage of RUN, or all.  [default: the last with a scene]"
)
@click.option(
    "--poses",
    type=click.Choice(["reference", "given"]),
    default="reference",
    show_default=True,
    help="Render at the reference's poses, or at those that RUN was given (or found) for these frames.",
)
@click.option(
    "--align",
    type=click.Path(path_type=Path),
    help="Folder whose cameras align the worlds, where RUN's poses are not the input's.  "
    "[default: --reference]",
)
@click.option(
    "--lpips",
    type=click.Choice([*LPIPS_NETS, "both", "none"]),
    default="both",
    show_default=True,
    help="Backbones of LPIPS; vgg takes most of the time.",
)
@click.option(
    "--scorers",
    callback=_scorers,
    default=",".join(SCORERS),
    show_default=True,
    help="No-reference scorers, separated by commas: names, paths of ONNX files, or none.",
)
@click.option(
    "--align-colour", is_flag=True, help="Fit each image's colours to its reference (affine on sRGB) first."
)
@click.option(
    "--refine-poses",
    type=click.IntRange(0, 200),
    default=0,
    show_default=True,
    help="Measure a second time, with each rendered pose fitted to its reference in this many steps.",
)
@click.option(
    "--save-renders",
    type=click.Path(path_type=Path),
    help="Keep the evaluated images (PNG) in this new folder.",
)
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="Result file (.json).")
@fail_below_option("psnr, ssim ...")
@threads_option
@json_option
@quiet_option
@click.pass_obj
def eval(
    dag: Stages,
    target: Path | None,
    directory: Path | None,
    renders: Path | None,
    stages: Sequence[str],
    poses: Literal["reference", "given"],
    align: Path | None,
    lpips: Literal["alex", "vgg", "both", "none"],
    scorers: tuple[str, ...],
    align_colour: bool,
    refine_poses: int,
    save_renders: Path | None,
    output: Path | None,
    fail_below: dict[str, float],
    threads: int,
    as_json: bool,
    quiet: bool,
) -> int:
    """Compare a scene with sharp images: PSNR, SSIM, LPIPS and no-reference scores.

    Images are rendered at the reference's size without exposure compensation and compared as 8-bit sRGB.
    """
    run = target if target is not None and target.is_dir() else None
    scenes = _scenes(dag, target, renders, stages)
    if output is not None and output.suffix != ".json":
        raise InputError(f"{output} does not end in .json", hint="name the result NAME.json")
    if run is None and (poses == "given" or align is not None):
        raise InputError("--poses given and --align need a run", hint="give the folder of `cleargs run -o`")
    if directory is None and poses == "given":
        raise InputError(
            "--poses given needs --reference", hint="held-out frames are rendered at their own poses anyway"
        )
    nets: tuple[LpipsNet, ...] = LPIPS_NETS if lpips == "both" else () if lpips == "none" else (lpips,)
    options = [
        EvalOptions(lpips=nets, scorers=scorers, align_colour=align_colour, refine_poses=steps)
        for steps in dict.fromkeys((0, refine_poses))
    ]
    from cleargs.evaluate.eval_report import Report, read_report, write_report
    from cleargs.evaluate.evaluate import evaluate_images, evaluate_scene
    from cleargs.evaluate.references import reference_of, views_trained_on

    given = (directory, renders, align, None if run else target)
    results = [] if output is None else [output, output.with_suffix(".parquet")]
    written = results if save_renders is None else [*results, save_renders]
    check_outputs(written, dag, run, inputs=[place for place in given if place is not None])
    if save_renders is not None and visible_names(save_renders):
        raise InputError(f"{save_renders} is not empty", hint="choose a new folder for --save-renders")
    if any(file.exists() for file in results):
        read_report(results[0])  # only results of this command are replaced
    reporter = make_reporter(quiet)
    reference = reference_of(run, directory, poses=poses, align=align, reporter=reporter)
    evaluations = []
    for (subject, scene), chosen in product(scenes.items(), options):
        save = save_renders / subject if save_renders is not None and len(scenes) > 1 else save_renders
        save = save / "refined" if save is not None and chosen.refine_poses else save
        found = evaluate_scene(
            scene, reference, options=chosen, threads=threads, reporter=reporter, subject=subject, save=save
        )
        trained = None if run is None else views_trained_on(run, subject, reference)
        evaluations.append(found.model_copy(update={"trained_on": trained}))
    if renders is not None:
        evaluations.append(
            evaluate_images(
                renders, reference, options=options[-1], threads=threads, reporter=reporter, save=save_renders
            )
        )
    report = Report(evaluations=tuple(evaluations))
    if output is None and run is not None and renders is None:
        name = reference.name if poses == "reference" or directory is None else f"{reference.name}-given"
        output = run / "eval" / name / "eval.json"
        write_report(output, report.merged_with(_older(run, output)))
    elif output is not None:
        write_report(output, report)
    if as_json:
        print_json(report.document())
    else:
        _print(report, output)
    return int(report_below({found.subject: found.means for found in report.evaluations}, fail_below))


def _older(run: Path, path: Path) -> Report:
    """Return the evaluations in ``path`` of scenes that ``run`` still has."""
    from cleargs.evaluate.eval_report import Report, read_report

    try:
        found = read_report(path).evaluations
    except InputError:
        return Report(evaluations=())  # none yet, or damaged
    scenes = {evaluation.subject: scene_path(run, evaluation.subject) for evaluation in found}
    digests = {subject: file_digest(scene) for subject, scene in scenes.items() if scene.is_file()}
    kept = (evaluation for evaluation in found if evaluation.scene == digests.get(evaluation.subject))
    return Report(evaluations=tuple(kept))


def _seen_before(report: Report) -> str:
    """Return a note if the scene was trained on frames of these views, or if this is unknown; else ""."""
    scenes = [found for found in report.evaluations if found.scene is not None]
    if any(found.trained_on is None for found in scenes):
        return "note: the frames of the scene's training are not known"
    seen = [found for found in scenes if found.trained_on]
    if not seen:
        return ""
    count = f"{seen[0].trained_on} of {len(seen[0].images)}"
    return f"note: {count} views are of frames that the scene was trained on"


def _scenes(dag: Stages, target: Path | None, renders: Path | None, stages: Sequence[str]) -> dict[str, Path]:
    """Return name -> file of each scene to render; empty if finished images are evaluated."""
    if renders is not None:
        if stages or (target is not None and not target.is_dir()):
            raise InputError("--renders takes the place of a scene", hint="leave out --stage and SCENE")
        return {}
    if target is None:
        raise InputError("there is nothing to evaluate", hint="give a RUN, a SCENE, or --renders DIR")
    if not target.exists():
        raise InputError(f"{target} does not exist", hint="give the folder of a run, or a scene file")
    if not target.is_dir():
        if stages:
            raise InputError("--stage chooses among the scenes of a run", hint="leave it out for a file")
        return {target.name: target}
    if not (target / RUN_FILE).is_file():
        raise InputError(
            f"{target} is not a run: it has no {RUN_FILE}", hint="give the folder of `cleargs run -o`"
        )
    check_links(target)
    check_results(dag, target)
    if "all" in stages:
        chosen = [
            name for name in dag.names if has_results(target, name) and scene_path(target, name).is_file()
        ]
    else:
        chosen = [scene_stage(dag, target, name) for name in dict.fromkeys(stages)]
    return {name: scene_path(target, name) for name in chosen or [scene_stage(dag, target, None)]}


def _print(report: Report, output: Path | None) -> None:
    from rich.console import Console
    from rich.table import Table

    from cleargs.evaluate.eval_report import LOWER_IS_BETTER

    first = report.evaluations[0]
    metrics = [name for name in first.options.metrics if name not in first.unavailable]
    table = Table("subject", "images", box=None, header_style="bold")
    for metric in metrics:
        arrow = "↓" if metric in LOWER_IS_BETTER else "↑"
        table.add_column(f"{_LABELS.get(metric, Path(metric).stem)} {arrow}", justify="right")
    for evaluation in report.evaluations:
        rows = {f"mean of {len(evaluation.images)}": evaluation.means, "as filmed": evaluation.formed}
        for images, means in rows.items():
            if means:
                table.add_row(_subject(evaluation), images, *(_figure(name, means[name]) for name in metrics))
    console = Console(highlight=False, markup=False, soft_wrap=True)  # names may contain brackets
    if line := _seen_before(report):
        console.print(line)
    console.print(table)
    for evaluation in report.evaluations:
        if lines := _regions(evaluation):
            console.print("\n  ".join([f"{_subject(evaluation)}:", *lines]))
    console.print(_provenance(first))
    for reason in dict.fromkeys(first.unavailable.values()):
        missing = [metric for metric, why in first.unavailable.items() if why == reason]
        console.print(f"{', '.join(missing)}: {reason}")
    if output is not None:
        console.print(f"written: {output}")


def _subject(evaluation: Evaluation) -> str:
    return evaluation.subject + (", poses refined" if evaluation.options.refine_poses else "")


def _provenance(evaluation: Evaluation) -> str:
    """Return a line with the conditions of the comparison."""
    words = [f"reference {evaluation.reference}, split {evaluation.split[:12]}"]
    if evaluation.poses == "given":
        words.append("at the run's own poses")
    if evaluation.alignment.residual is not None:
        words.append(f"worlds aligned, residual {evaluation.alignment.residual:.2%}")
    if evaluation.options.align_colour:
        words.append("colours aligned")
    return "; ".join(words)


def _regions(evaluation: Evaluation) -> list[str]:
    """Return lines with the PSNR in regions in which scenes often fail, and in other comparisons."""
    parts = {"behind the sparse points": evaluation.far, "clipped in the references": evaluation.clipped}
    lines = [
        f"{name}: {_figure('psnr', part.psnr)} dB on {part.share:.1%} of the pixels"
        for name, part in parts.items()
        if part is not None and part.psnr is not None and part.share >= SMALLEST_SHARE
    ]
    if evaluation.psnr_white is not None:
        lines.append(f"over white: {evaluation.psnr_white:.2f} dB")
    if evaluation.psnr_between is not None:
        between = _figure("psnr", evaluation.psnr_between)
        lines.append(f"its background against white: {between} dB; above {OPAQUE_DB} it does not show")
    plain, aligned = evaluation.means.get("psnr"), evaluation.psnr_colour_aligned
    if plain is not None and aligned is not None and aligned - plain > EXPOSURES_DIFFER:
        lines.append(f"exposures differ: {aligned:.2f} dB with aligned colours (--align-colour)")
    if evaluation.covered is not None:
        lines.append(f"behind Gaussians in front of the true surface: {evaluation.covered:.1%} of the pixels")
    return lines


def _figure(metric: str, value: float | None) -> str:
    return "-" if value is None else f"{value:.{_DIGITS.get(metric, 2)}f}"
