"""Write ``OUT/report/index.html``: losses of the whole method, then pictures and tables of all variants."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import ChoiceLoader, Environment, FileSystemLoader

from benchmarks.comparison.cells import Cell, Cells, ViewSet
from benchmarks.comparison.findings import Comparison
from benchmarks.comparison.gaps import compared_with, losses_of, losses_table
from benchmarks.comparison.scenes import FinishedScene, view_sets
from benchmarks.comparison.tables import (
    NAMES,
    TITLES,
    Bold,
    Table,
    choices_table,
    difference_table,
    format_value,
    metric_title,
    note_on,
    roles_table,
    value_text,
    work_table,
)
from benchmarks.comparison.variants import WHOLE
from cleargs.capture.tables import load_frames
from cleargs.evaluate.eval_report import Evaluation
from cleargs.evaluate.reference_views import ReferenceView, stem_of
from cleargs.evaluate.references import reference_of
from cleargs.files import whole_folder
from cleargs.media.image import read_rgb
from cleargs.progress import SilentReporter
from cleargs.report.html import page_environment, page_html
from cleargs.report.pictures import ImageFile, side_of, write_jpeg
from cleargs.report.report_json import PAGE, page_of

MAX_POSES = 3
"""Maximum number of poses per capture and set of views; they are spaced evenly."""
MAX_PICTURES = 1500
"""Maximum number of pictures: above it, fewer poses are shown, but at least one per set of views."""
MAX_BYTES = 20_000_000
"""Approximate limit for the size of all pictures together."""

REFERENCE, FILMED = "reference", "filmed"
_FOLDER = "poses"
_SHOWN_METRICS = ("psnr", "lpips_vgg", "lpips_alex")


@dataclass(frozen=True)
class PageView:
    """A pose from which the scenes of a capture are shown."""

    number: int
    views: ViewSet
    name: str
    size: tuple[int, int]
    pictures: Mapping[str, ImageFile]
    """Layer -> picture: `REFERENCE`, `FILMED` if a frame was filmed there, then the variants' renders."""
    notes: Mapping[str, str]
    """Layer of a render -> its main figures."""
    figures: Sequence[tuple[str, Sequence[tuple[str, str]]]]
    """Title of each metric, with (label, value) of each variant."""


@dataclass
class CaptureResults:
    """Tables and pictures of the scenes in one column."""

    name: str
    tables: list[tuple[ViewSet, str, str, Table]] = field(default_factory=list)
    """Set of views, its title, a note on it, and values by variant and metric."""
    poses: list[PageView] = field(default_factory=list)


def write_comparison(
    out: Path,
    compared: Comparison,
    baselines: Sequence[str],
    made_with: Sequence[str],
    warnings: Sequence[str],
) -> Path:
    """Write the report of a comparison; it replaces an older one.

    Args:
        out: Folder of the comparison.
        compared: Its results.
        baselines: Variants that are subtracted from the others in tables of differences.
        made_with: Lines on settings and versions.
        warnings: Lines that are shown first.

    Returns:
        Path of the page.

    Raises:
        StoreError: The report cannot be written, or a result cannot be read.
        InputError: A reference or capture cannot be read.
    """
    cells, labels = compared.results.cells, compared.labels
    layers = {name: f"v{place}" for place, name in enumerate(cells.variants())}
    subject = WHOLE if WHOLE in labels else cells.variants()[-1]
    samples = {(cell.column, cell.sample) for cell in cells.cells}
    with whole_folder(page_of(out).parent, replace=True) as folder:
        captures = _captures(out, folder, compared, layers)
        html = page_html(
            _environment().get_template("compare.html.jinja"),
            name=out.name,
            aspect=None,
            captures=captures,
            variants=list(labels.values()),
            layer_names=_layer_names(layers, labels),
            warnings=[*warnings, *compared.failures],
            samples=max(Counter(column for column, _ in samples).values()),
            **_subject_facts(cells, labels, subject),
            differences=[
                (TITLES[views], labels[baseline], difference_table(cells, labels, views, baseline))
                for views in cells.view_sets()
                for baseline in baselines
                if baseline in labels and len(labels) > 1
            ],
            equal=_equal_work(cells),
            work=work_table(cells, labels),
            roles=roles_table(compared.roles, labels),
            choices=choices_table(compared.choices, labels) if compared.choices else None,
            made_with=made_with,
            data=_data(captures, layers, labels, subject),
        )
        (folder / PAGE).write_bytes(html)
    return page_of(out)


def _environment() -> Environment:
    """Return the templates of the report and of this page."""
    environment = page_environment()
    assert environment.loader is not None
    environment.loader = ChoiceLoader([FileSystemLoader(Path(__file__).parent), environment.loader])
    environment.tests["bold"] = lambda text: isinstance(text, Bold)
    return environment


def _subject_facts(cells: Cells, labels: Mapping[str, str], subject: str) -> dict[str, Any]:
    """Return template values on the subject's losses against the other variants."""
    found = losses_of(cells, subject)
    places = [((loss.column, TITLES[loss.views].split(",")[0], labels[loss.against]), loss) for loss in found]
    return {
        "subject": labels[subject],
        "pairs": sum(1 for _ in compared_with(cells, subject)),
        "behind": len(found),
        "significance": Counter(loss.significance for loss in found),
        "losses": losses_table(("capture", "views", "worse than"), places),
    }


def _equal_work(cells: Cells) -> bool:
    """Return True if all variants of a sample have equal steps and SH degree."""
    given = {(cell.sample, cell.steps, cell.sh_degree) for cell in cells.cells}
    return len(given) == len({sample for sample, _, _ in given})


# -- captures -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _PoseInput:
    """A pose and the images to show there."""

    views: ViewSet
    view: ReferenceView
    filmed: Path | None
    renders: Sequence[tuple[str, Cell, Evaluation]]
    """Layer, cell and evaluation of each variant."""


def _captures(
    out: Path, folder: Path, compared: Comparison, layers: Mapping[str, str]
) -> list[CaptureResults]:
    cells, labels = compared.results.cells, compared.labels
    columns = list(dict.fromkeys(cell.column for cell in cells.cells))
    sets = len({(cell.column, cell.views) for cell in cells.cells})
    poses = max(1, min(MAX_POSES, MAX_PICTURES // (sets * (len(layers) + 2))))
    inputs = {column: list(_pose_inputs(out, compared, column, layers, poses)) for column in columns}
    pictures = sum(2 + len(pose.renders) for found in inputs.values() for pose in found)
    (folder / _FOLDER).mkdir()
    captures, numbers = [], 0
    for column, found in inputs.items():
        capture = CaptureResults(column)
        for views in cells.view_sets():
            if column in cells.columns(views):
                values = _values(cells, labels, views, column)
                capture.tables.append((views, TITLES[views], note_on(cells, views), values))
        for pose in found:
            capture.poses.append(_write_pose(pose, numbers, pictures, out, folder, labels))
            numbers += 1
        captures.append(capture)
    return captures


def _values(cells: Cells, labels: Mapping[str, str], views: ViewSet, column: str) -> Table:
    metrics = cells.metrics()
    rows = [
        [labels[variant], *(value_text(cells, views, column, variant, metric) for metric in metrics)]
        for variant in cells.variants()
        if cells.of(views, column, variant)
    ]
    return Table(["", *map(metric_title, metrics)], rows)


def _pose_inputs(
    out: Path, compared: Comparison, column: str, layers: Mapping[str, str], poses: int
) -> Iterator[_PoseInput]:
    """Yield poses of the first capture of a column."""
    scenes = [scene for scene in compared.scenes if scene.sample.column == column]
    first = scenes[0]
    samples = {scene.sample.name for scene in scenes if scene.sample.capture == first.sample.capture}
    for found in view_sets(first):
        if found.views == "given":  # its pictures almost equal those of the true poses
            continue
        own: dict[str, Cell] = {}
        for cell in compared.cells:
            if cell.sample in samples and cell.views == found.views:
                own.setdefault(cell.variant, cell)
        renders = [(layers[variant], cell, _evaluation(out, cell)) for variant, cell in own.items()]
        reference = reference_of(
            first.run, found.directory, poses=found.poses, align=found.align, reporter=SilentReporter()
        )
        filmed = _filmed(first) if found.views == "observed" else {}
        for view in _evenly_spaced(reference.views, poses):
            yield _PoseInput(found.views, view, filmed.get(view.name), renders)


def _evaluation(out: Path, cell: Cell) -> Evaluation:
    return Evaluation.model_validate_json((out / cell.evaluation / "eval.json").read_bytes())


def _filmed(scene: FinishedScene) -> dict[str, Path]:
    """Return the image of each filmed frame by its stem."""
    ingest = scene.run / "ingest"
    return {stem_of(frame.name): ingest / frame.image for frame in load_frames(ingest)}


def _evenly_spaced(views: Sequence[ReferenceView], wanted: int) -> list[ReferenceView]:
    wanted = min(wanted, len(views))
    return [views[(2 * place + 1) * len(views) // (2 * wanted)] for place in range(wanted)]


def _write_pose(
    pose: _PoseInput, place: int, pictures: int, out: Path, folder: Path, labels: Mapping[str, str]
) -> PageView:
    """Write the pictures of a pose; the page has at most ``pictures`` pictures."""
    reference = pose.view.load()[0]
    height, width = reference.shape[:2]
    side = side_of(pictures, height / width, MAX_BYTES)
    images = {REFERENCE: reference}
    if pose.filmed is not None:
        images[FILMED] = read_rgb(pose.filmed)
    notes: dict[str, str] = {}
    figures: dict[str, list[tuple[str, str]]] = {}
    for layer, cell, evaluation in pose.renders:
        image = next((image for image in evaluation.images if image.name == pose.view.name), None)
        if image is None:  # this run has other references
            continue
        images[layer] = read_rgb(out / cell.evaluation / f"{pose.view.name}.png")
        notes[layer] = _note(image.values)
        for metric, value in image.values.items():
            if value is not None:
                figures.setdefault(metric, []).append((labels[cell.variant], format_value(value, metric)))
    return PageView(
        place,
        pose.views,
        pose.view.name,
        (width, height),
        {
            layer: write_jpeg(folder, f"{_FOLDER}/{place:03d}-{layer}.jpg", image, side)
            for layer, image in images.items()
        },
        notes,
        [(metric_title(metric), values) for metric, values in figures.items()],
    )


def _note(values: Mapping[str, float | None]) -> str:
    """Return PSNR and one LPIPS as text, if they were measured."""
    shown = [metric for metric in _SHOWN_METRICS if values.get(metric) is not None][:2]
    texts = {metric: format_value(values[metric] or 0.0, metric) for metric in shown}
    return " · ".join(
        f"{text} dB" if metric == "psnr" else f"{NAMES[metric]} {text}" for metric, text in texts.items()
    )


def _layer_names(layers: Mapping[str, str], labels: Mapping[str, str]) -> dict[str, str]:
    renders = {layer: labels[variant] for variant, layer in layers.items()}
    return {REFERENCE: "Reference", FILMED: "As filmed", **renders}


def _data(
    captures: Sequence[CaptureResults], layers: Mapping[str, str], labels: Mapping[str, str], subject: str
) -> dict[str, Any]:
    """Return the data for the script of the page."""
    return {
        "layers": _layer_names(layers, labels),
        "opening": {"left": REFERENCE, "right": layers[subject]},
        "frames": [
            {
                "id": pose.number,
                "title": f"{capture.name} · {pose.name}",
                "role": TITLES[pose.views],
                "aspect": f"{pose.size[0]} / {pose.size[1]}",
                "layers": {layer: picture.path for layer, picture in pose.pictures.items()},
                "notes": pose.notes,
                "figures": pose.figures,
            }
            for capture in captures
            for pose in capture.poses
        ],
    }
