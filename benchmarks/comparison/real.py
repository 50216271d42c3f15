"""Real captures by the protocols of the literature, next to published figures: ``real.toml``."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pydantic import Field, ValidationError

from benchmarks.comparison.cells import Cell, Cells, Spread
from benchmarks.comparison.findings import Comparison, compare_scenes
from benchmarks.comparison.front_page import BASELINE, bold_difference, has_block, with_block, without_digest
from benchmarks.comparison.pictures import find_image
from benchmarks.comparison.scenes import Sample, SceneRecipe, evaluate_views, make_scenes
from benchmarks.comparison.tables import Table
from benchmarks.comparison.variants import VARIANTS, WHOLE, find_variants
from benchmarks.images import read_rgb_float
from cleargs.base_model import FrozenModel
from cleargs.capture.tables import load_frames
from cleargs.errors import CleargsError, InputError
from cleargs.evaluate.eval_report import Figures
from cleargs.media.contact_sheet import Tile, contact_sheet
from cleargs.media.image import write_rgb
from cleargs.pipeline.store import Store
from cleargs.progress import Reporter
from cleargs.safe_io import read_bytes, read_text

SHOWCASE = "blurball"
"""Scene in the example picture. Its licence (CC BY 4.0) allows publication."""
SHOWN = "001"
"""Stem of the blurred photograph in the example picture. The other images show the first held-out view."""
REFINE_STEPS = 15
"""Number of steps that fit each test pose for the metrics of `REFINED`."""
REFINED = {"psnr": "psnr_refined", "lpips_alex": "lpips_alex_refined"}
"""Metric -> its name when the test poses were fitted to the test images first."""

SHORT, FULL = "real", "real-full"
"""Names of the places for the two tables in a page."""
_LABELS = {variant.name: variant.label for variant in VARIANTS} | {BASELINE: "all frames alike"}
"""Variant -> label, in the order of the rows."""
_COMPARED = (BASELINE, WHOLE)
"""Variants of the short table."""


class RealScene(FrozenModel):
    """A capture with its protocol."""

    name: str
    shows: str
    """Content and quality of the capture, for readers."""
    capture: str
    """Path in the folder of the captures."""
    settings: tuple[str, ...]
    steps: int | None = Field(None, ge=1)
    protocol: str


class Published(FrozenModel):
    """A published result."""

    scene: str
    method: str
    psnr: float
    ssim: float | None = None
    lpips: float | None = None
    source: str
    protocol: str
    second_hand: bool = False
    """True if the figures were read in another text than the paper or its log."""


class RealList(FrozenModel):
    """``real.toml``."""

    scenes: tuple[RealScene, ...] = Field(min_length=1)
    published: tuple[Published, ...]


def read_real_list() -> RealList:
    """Read ``real.toml``."""
    return RealList.model_validate(tomllib.loads(read_text(Path(__file__).with_name("real.toml"))))


def find_scenes(listed: RealList, names: Sequence[str]) -> tuple[RealScene, ...]:
    """Return the named scenes, or all without names; raise InputError for an unknown name."""
    known = [scene.name for scene in listed.scenes]
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"no scene is called {unknown[0]!r}", hint=f"choose among {', '.join(known)}")
    return tuple(scene for scene in listed.scenes if not names or scene.name in names)


def run_scenes(
    out: Path,
    captures: Path,
    scenes: Sequence[RealScene],
    variants: Sequence[str],
    seeds: int,
    recipe: SceneRecipe,
    store: Store,
    reporter: Reporter,
) -> Comparison:
    """Train and evaluate each variant on each scene; results of an earlier call are reused.

    Args:
        out: Folder of the benchmark.
        captures: Folder of the captures.
        scenes: Scenes to run.
        variants: Names of the variants.
        seeds: Number of trainings, with seeds from 0.
        recipe: Settings that all runs share.
        store: Store of the runs.
        reporter: Receives progress and warnings.

    Returns:
        The results. `REFINED` names the metrics with refined test poses. Missing captures and scenes are
        among the failures.
    """
    found = Comparison()
    for scene in scenes:
        place = captures / scene.capture
        if not place.exists():
            found.failures.append(f"{scene.name}: {place} does not exist")
            reporter.warn(found.failures[-1])
            continue
        own = replace(
            recipe, overrides=(*scene.settings, *recipe.overrides), steps=recipe.steps or scene.steps
        )
        refined = replace(own, options=own.options.model_copy(update={"refine_poses": REFINE_STEPS}))
        samples = [Sample(place.absolute(), seed, None, scene.name) for seed in range(seeds)]
        made = make_scenes(out, samples, find_variants(variants), own, store, reporter)
        try:
            compared = compare_scenes(out, made, own, store, reporter)
            for number, finished in enumerate(compared.scenes):
                (cell,) = evaluate_views(out, finished, refined, store, reporter)
                again = {name: cell.means.get(metric) for metric, name in REFINED.items()}
                means = compared.cells[number].means | again
                compared.cells[number] = compared.cells[number].model_copy(update={"means": means})
        except CleargsError as error:
            found.failures.append(f"{scene.name}: {error}")
            continue
        found.add(compared)
    return found


class Trainings(Figures):
    """Results of one variant on one scene: one cell per seed."""

    version: str
    """Version of the source that made them."""
    cells: tuple[Cell, ...] = Field(min_length=1)


class RealResults(Figures):
    """Content of ``OUT/real.json``: results of all scenes and variants, which may come from several calls."""

    scenes: dict[str, dict[str, Trainings]] = Field(default_factory=dict)
    """Scene -> variant -> results."""
    failures: tuple[str, ...] = ()
    """Names of the scenes that the last call could not make, with the reason."""

    def with_results(self, found: Comparison, version: str) -> RealResults:
        """Return the results of ``found``, and all others that an earlier call has stored."""
        grouped: dict[str, dict[str, list[Cell]]] = {}
        for cell in found.cells:
            grouped.setdefault(cell.column, {}).setdefault(cell.variant, []).append(cell)
        scenes = dict(self.scenes)
        for name, variants in grouped.items():
            made = {
                variant: Trainings(version=version, cells=tuple(cells)) for variant, cells in variants.items()
            }
            both = scenes.get(name, {}) | made
            scenes[name] = {variant: both[variant] for variant in _LABELS if variant in both}
        return RealResults(scenes=scenes, failures=tuple(found.failures))

    @property
    def cells(self) -> Cells:
        return Cells(cell for scene in self.scenes.values() for made in scene.values() for cell in made.cells)


def read_results(path: Path) -> RealResults:
    """Read ``real.json``; return empty results if the file is missing.

    Raises:
        InputError: if the file cannot be read, or has another form.
    """
    if not path.exists():
        return RealResults()
    try:
        return RealResults.model_validate_json(read_bytes(path))
    except (OSError, ValidationError) as error:
        hint = "move it away, and repeat the command that made it: trainings in the store are not repeated"
        raise InputError(f"{path} cannot be read, or has another form", hint=hint) from error


def real_table(listed: RealList, found: RealResults) -> str:
    """Return all results and the published figures, with their conditions, as Markdown."""
    cells = found.cells
    head = ["", "", "PSNR", "SSIM", "LPIPS (AlexNet)"]
    head += ["PSNR, test poses refined", "LPIPS, test poses refined", "processor minutes"]
    rows, notes = [], []
    for scene in listed.scenes:
        stored = found.scenes.get(scene.name)
        if stored is None:
            continue
        rows += [[scene.name, _LABELS[variant], *_figures(cells, scene.name, variant)] for variant in stored]
        first = next(iter(stored.values())).cells[0]
        notes.append(
            f"* {scene.name}: {scene.protocol}; {first.images} views, {first.steps:,} steps; "
            f"{_origins(stored)}."
        )
        rows += [_published(one) for one in listed.published if one.scene == scene.name]
    names = {scene.name for scene in listed.scenes}
    rows += [_published(one) for one in listed.published if one.scene not in names]
    notes += [
        f"* {one.method}: {one.source}; {one.protocol}."
        for one in listed.published
        if one.scene not in names or one.scene in found.scenes
    ]
    line = (
        "± is the standard deviation over the trainings. Published results are in italics; those marked * "
        "were read at second hand."
    )
    missing = [f"* Not made: {failure}." for failure in found.failures]
    return "\n\n".join([Table(head, rows).markdown(), line, "\n".join([*notes, *missing]), _COMMAND])


def summary_table(listed: RealList, found: RealResults) -> str:
    """Return one row per scene, with the published figures of these scenes, as Markdown."""
    head = ["real capture", "all frames alike", "ClearGS", "difference", "processor minutes"]
    rows, absent = [], []
    origins: dict[str, list[str]] = {}
    for scene in listed.scenes:
        stored = found.scenes.get(scene.name, {})
        shown = {variant: made for variant, made in stored.items() if variant in _COMPARED}
        if not shown:
            absent.append(scene.name)
            continue
        before, after = (found.cells.of("held-out", scene.name, name) for name in _COMPARED)
        differences = (
            found.cells.difference("held-out", scene.name, WHOLE, BASELINE, metric) for metric in REFINED
        )
        rows.append(
            [
                f"{scene.name}: {scene.shows}",
                *(_short(found.cells, scene.name, name) for name in _COMPARED),
                " / ".join(
                    "-" if one is None else bold_difference(one, digits)
                    for one, digits in zip(differences, (2, 3), strict=True)
                ),
                f"{_minutes(before)} and {_minutes(after)}",
            ]
        )
        for one in listed.published:
            if one.scene == scene.name:
                lpips = "-" if one.lpips is None else f"{one.lpips:.3f}"
                rows.append([f"*{one.method}, on {one.scene}*", "", f"*{one.psnr:.2f} / {lpips}*", "", ""])
        origins.setdefault(without_digest(_origins(shown)), []).append(scene.name)
    made = ". ".join(f"{', '.join(names)}: {origin}" for origin, names in origins.items())
    line = (
        "PSNR in dB / LPIPS (AlexNet) on held-out frames, at equal steps and Gaussians. If the motion of the "
        "camera was measured, the scene of ClearGS is compared as the camera took the frames. ± is the "
        "standard deviation over the trainings, and in the differences half their 95 % interval; bold "
        f"excludes zero. {made}."
    )
    if absent:
        line += f" Still to be measured: {', '.join(absent)}."
    return f"{Table(head, rows).markdown()}\n\n{line}"


def with_tables(page: str, listed: RealList, found: RealResults) -> str:
    """Return ``page`` with the tables in their places `SHORT` and `FULL`.

    Raises:
        InputError: if the page has neither place.
    """
    if not has_block(page, FULL):
        return with_block(page, SHORT, summary_table(listed, found))
    if has_block(page, SHORT):
        page = with_block(page, SHORT, summary_table(listed, found))
    return with_block(page, FULL, real_table(listed, found))


_COMMAND = "Command: `python -m benchmarks real -o OUT --captures DIR`."


def _origins(stored: Mapping[str, Trainings]) -> str:
    """Return number of trainings and version, with the labels of the variants if these differ."""
    origins: dict[str, list[str]] = {}
    for variant, made in stored.items():
        count = len(made.cells)
        trainings = f"mean of {count} trainings" if count > 1 else "one training"
        origins.setdefault(f"{trainings}, version {made.version}", []).append(_LABELS[variant])
    if len(origins) == 1:
        return next(iter(origins))
    return "; ".join(f"{', '.join(labels)}: {origin}" for origin, labels in origins.items())


def _text(spread: Spread | None, digits: int) -> str:
    """Return a mean, and the standard deviation over the trainings if there are several."""
    if spread is None:
        return "-"
    more = f" ± {spread.deviation:.{digits}f}" if spread.deviation is not None else ""
    return f"{spread.mean:.{digits}f}{more}"


def _short(cells: Cells, column: str, variant: str) -> str:
    psnr, lpips = (cells.spread("held-out", column, variant, name) for name in REFINED)
    return _text(psnr, 2) if lpips is None else f"{_text(psnr, 2)} / {_text(lpips, 3)}"


def _figures(cells: Cells, column: str, variant: str) -> list[str]:
    metrics = (("psnr", 2), ("ssim", 3), ("lpips_alex", 3), *zip(REFINED.values(), (2, 3), strict=True))
    return [
        *(_text(cells.spread("held-out", column, variant, metric), digits) for metric, digits in metrics),
        _minutes(cells.of("held-out", column, variant)),
    ]


def _minutes(cells: Sequence[Cell]) -> str:
    known = [cell.cpu_seconds for cell in cells if cell.cpu_seconds is not None]
    return f"{sum(known) / len(known) / 60:.1f}" if known else "-"


def _published(one: Published) -> list[str]:
    figures = [f"{value:.3f}" if value is not None else "-" for value in (one.ssim, one.lpips)]
    return [
        one.scene,
        f"*{one.method}*{' *' if one.second_hand else ''}",
        f"{one.psnr:.2f}",
        *figures,
        "-",
        "-",
        "-",
    ]


def showcase(path: Path, out: Path, found: Comparison) -> bool:
    """Write an image of `SHOWCASE`: blurred photograph, all frames alike, ClearGS, sharp reference, in a row.

    Returns:
        False if its scenes were not made.
    """
    cells = {cell.variant: cell for cell in reversed(found.cells) if cell.column == SHOWCASE}
    scene = next((one for one in found.scenes if one.sample.column == SHOWCASE), None)
    if scene is None or "full" not in cells:
        return False
    view = sorted(path.stem for path in (out / cells["full"].evaluation).glob("*.png"))[0]
    ingest = scene.run / "ingest"
    images = {Path(frame.name).stem: ingest / frame.image for frame in load_frames(ingest)}
    tiles = [Tile(read_rgb_float(images[SHOWN]), "photograph")]
    tiles += [
        Tile(find_image(out / cells[name].evaluation, view), label)
        for name, label in (("all-view", "all frames alike"), ("full", "ClearGS"))
        if name in cells
    ]
    tiles.append(Tile(read_rgb_float(images[view]), "reference"))
    write_rgb(path, contact_sheet([tiles], tile_width=480))
    return True
