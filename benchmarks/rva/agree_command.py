"""``rva agree``: compare evaluators on the frames of a run."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cleargs.cli.common import DONE_IN_PART, json_option, print_json, quiet_option, run_argument, work_options
from cleargs.cli.progress_bars import make_reporter
from cleargs.digest import tree_digest
from cleargs.errors import InputError
from cleargs.manifest import linked_manifest
from cleargs.pipeline.config import Config, check_document, merge, parse_override
from cleargs.pipeline.keys import key_config
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.session import DeviceChoice, resolve_device
from cleargs.pipeline.stages import Stages
from cleargs.progress import Reporter

if TYPE_CHECKING:
    from benchmarks.rva.agreement import EvaluatorCues, RankAgreement
    from cleargs.capture.tables import Frame

FOLDER = "agree"
"""Folder in the run for the scores, figures and pictures of ``agree``."""

_SHEET_COLUMNS = 3
_TILE_WIDTH = 480  # px


def _names(context: click.Context, parameter: click.Parameter, value: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(part.strip() for part in value.split(",") if part.strip()))
    if len(names) < 2:
        raise click.BadParameter("give at least two, separated by commas, e.g. statistics,qwen3-vl")
    return names


@click.command(
    epilog="""\b
Examples:
  python -m benchmarks rva agree room --evaluators statistics,qwen3-vl
  python -m benchmarks rva agree room --evaluators qwen3-vl:qwen3-vl:4b,qwen3-vl:qwen3-vl:8b
  python -m benchmarks rva agree room --evaluators statistics,qwen3-vl --set rva.qwen.base_url=http://127.0.0.1:11434/v1
"""
)
@run_argument
@click.option(
    "--evaluators",
    required=True,
    callback=_names,
    metavar="A,B,...",
    help="Two or more: statistics, qwen3-vl, or qwen3-vl:MODEL.",
)
@click.option(
    "--most", type=click.IntRange(min=0), default=9, show_default=True, help="Number of frames to show."
)
@click.option("--set", "overrides", multiple=True, metavar="rva.FIELD=VALUE", help="Change one setting.")
@work_options
@json_option
@quiet_option
@click.pass_obj
def agree(
    dag: Stages,
    run: Path,
    evaluators: tuple[str, ...],
    most: int,
    overrides: tuple[str, ...],
    device: DeviceChoice,
    threads: int,
    as_json: bool,
    quiet: bool,
) -> int:
    """Compare evaluators on the frames of RUN and show the frames on which they disagree.

    The run does not change: scores, figures and contact sheets are written to RUN/agree. A repeated command
    reuses the scores.
    """
    from benchmarks.rva.agreement import compare
    from cleargs.capture.tables import load_frames
    from cleargs.files import write_json

    reporter = make_reporter(quiet)
    settings = read_run_file(run, dag, device=resolve_device(device, reporter.info))
    if linked_manifest(run, "ingest") is None:
        raise InputError(f"ingest is not done in {run}", hint=f"first: cleargs stage ingest {run}")
    ingest = (run / "ingest").resolve()
    frames = [frame for frame in load_frames(ingest) if frame.split == "train"]
    configs = [_config(dag, settings.config, name, overrides) for name in evaluators]
    sides = [
        _own_cues(dag, run, config, frames)
        or _cues_of(run, ingest, config, frames, settings.config.seed, settings.device, threads, reporter)
        for config in configs
    ]

    frame_id, names = [frame.frame_id for frame in frames], [frame.name for frame in frames]
    documents, agreements = [], []
    for (i, first), (j, second) in combinations(enumerate(sides), 2):
        agreement = compare(first, second, configs[0], most=most)
        sheet = run / FOLDER / f"{_plain(evaluators[i])}--{_plain(evaluators[j])}.png"
        shown = str(_write_sheet(sheet, agreement, frames, ingest)) if agreement.disagreements else None
        agreements.append(agreement)
        documents.append({**agreement.document(frame_id, names), "sheet": shown})
    unscored = {
        side.evaluator: [
            id_ for id_, row in zip(frame_id, side.cues, strict=True) if bool((row != row).any())
        ]
        for side in sides
    }
    document = {"run": str(run), "frames": len(frames), "unscored": unscored, "pairs": documents}
    write_json(run / FOLDER / "agreement.json", document)
    if as_json:
        print_json(document)
    else:
        _print(document)
    return DONE_IN_PART if any(unscored.values()) else 0


def _config(dag: Stages, config: Config, name: str, overrides: Sequence[str]) -> Any:
    """Return the run's settings of RVA with another evaluator, NAME or NAME:MODEL."""
    evaluator, _, model = name.partition(":")
    document = config.document()
    for text in overrides:
        document = merge(document, parse_override(text))
    change: dict[str, Any] = {"evaluator": evaluator}
    if model:
        change["qwen"] = {"model": model}
    return check_document(dag, merge(document, {"rva": change})).sections["rva"]


def _own_cues(dag: Stages, run: Path, config: Any, frames: Sequence[Frame]) -> EvaluatorCues | None:
    """Return the cues in the run's table if this evaluator measured them on these images, else None."""
    import numpy as np

    from benchmarks.rva.agreement import EvaluatorCues
    from cleargs.parquet import read_table
    from cleargs.rva.tables import CUE_COLUMNS, FRAMES

    made, ingest = linked_manifest(run, "rva"), linked_manifest(run, "ingest")
    if made is None or ingest is None or made.missing or made.parts.version != dag.load("rva").VERSION:
        return None
    wanted = key_config(config)
    if any(made.parts.config.get(name) != wanted[name] for name in ("evaluator", "qwen")):
        return None
    images = ingest.under("images")
    if made.parts.inputs["ingest"]["images"] != tree_digest(images):
        return None
    table = read_table((run / "rva").resolve() / "frames.parquet", FRAMES)
    if table["frame_id"].to_pylist() != [frame.frame_id for frame in frames]:
        return None
    cues = np.column_stack([table[column].to_numpy() for column in CUE_COLUMNS])
    return EvaluatorCues(table["evaluator"][0].as_py(), cues)


def _cues_of(
    run: Path,
    ingest: Path,
    config: Any,
    frames: Sequence[Frame],
    seed: int,
    device: Any,
    threads: int,
    reporter: Reporter,
) -> EvaluatorCues:
    """Score the frames, or read the scores of an earlier call from RUN/agree."""
    from benchmarks.rva.agreement import EvaluatorCues
    from cleargs.rva.evaluator import EvaluatedFrame, label
    from cleargs.rva.evaluators import make_evaluator

    evaluator = make_evaluator(config, seed=seed, device=device, cache=run / FOLDER / "scores")
    views = [
        EvaluatedFrame(frame.frame_id, ingest / frame.image, ingest / frame.mask if frame.mask else None)
        for frame in frames
    ]
    cues = evaluator.evaluate(views, threads=threads, reporter=reporter)
    return EvaluatorCues(label(evaluator), cues)


def _write_sheet(path: Path, agreement: RankAgreement, frames: Sequence[Frame], ingest: Path) -> Path:
    """Write a contact sheet of the frames with the widest gaps and the scores of both evaluators."""
    from benchmarks.images import read_rgb_float
    from cleargs.media.contact_sheet import Tile, contact_sheet
    from cleargs.media.image import write_rgb

    tiles = [
        Tile(
            read_rgb_float(ingest / frames[d.row].image),
            f"{frames[d.row].frame_id}: R {d.R[0]:.2f} | {d.R[1]:.2f}  B {d.B[0]:.2f} | {d.B[1]:.2f}"
            f"  place {d.rank[0]} | {d.rank[1]} of {agreement.frames}",
        )
        for d in agreement.disagreements
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [tiles[k : k + _SHEET_COLUMNS] for k in range(0, len(tiles), _SHEET_COLUMNS)]
    write_rgb(path, contact_sheet(rows, tile_width=_TILE_WIDTH))
    return path


def _plain(name: str) -> str:
    """Return ``name`` with the characters replaced that are unsafe in a file name."""
    return "".join(letter if letter.isalnum() or letter in "-._" else "_" for letter in name)


def _print(document: dict[str, Any]) -> None:
    """Print the report in the terminal."""
    for pair in document["pairs"]:
        first, second = pair["evaluators"]
        click.echo(f"{first} | {second}: {pair['frames']} of {document['frames']} frames scored by both")
        click.echo("Spearman's rank correlation:")
        for name, value in pair["spearman"].items():
            click.echo(f"  {name:<22} {'constant' if value is None else f'{value:+.3f}'}")
        counts = pair["reliable"]
        click.echo(
            f"reliable: both {counts['both']}, only the first {counts['first_only']}, "
            f"only the second {counts['second_only']}, neither {counts['neither']}"
        )
        for d in pair["disagreements"]:
            click.echo(
                f"  frame {d['frame_id']:>5}  gap {d['gap']:.2f}  R {d['R'][0]:.2f} | {d['R'][1]:.2f}  "
                f"B {d['B'][0]:.2f} | {d['B'][1]:.2f}  place {d['rank'][0]} | {d['rank'][1]}  {d['name']}"
            )
        if pair["sheet"]:
            click.echo(f"picture: {pair['sheet']}")
    for evaluator, missing in document["unscored"].items():
        if missing:
            click.echo(f"missing: {evaluator} did not score {', '.join(map(str, missing))}", err=True)
