"""Run variants on captures and evaluate each scene: the cells of the paper's tables.

``OUT/<capture>-<seed>/<variant>`` are ordinary run folders. They share ``OUT/.store``, so equal stages of
several variants run once, and an interrupted comparison can be resumed. ``OUT/evaluations`` caches
evaluations by content.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from benchmarks.comparison.cells import Cell, ViewSet
from benchmarks.comparison.equal_work import EqualWork, decide_work, variant_config
from benchmarks.comparison.variants import Variant
from cleargs.digest import json_digest
from cleargs.errors import CleargsError, InputError
from cleargs.evaluate.config import EvalOptions
from cleargs.evaluate.eval_report import Evaluation
from cleargs.files import write_bytes
from cleargs.manifest import Manifest, linked_manifest
from cleargs.parquet import read_errors
from cleargs.pipeline.config import Config, load_config, read_toml
from cleargs.pipeline.run_file import RUN_FILE, RunSpec, read_run_file
from cleargs.pipeline.runner import Runner
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import Store
from cleargs.progress import Reporter, SilentReporter
from cleargs.safe_io import read_bytes, read_json
from cleargs.scene.folder import SceneFolder
from cleargs.splat.ply import read_ply
from cleargs.types import Device

EVALUATION_VERSION = 4
"""Version of the cache. Increase it when an evaluation of equal inputs gives other figures."""


def capture_name(capture: Path) -> str:
    """Return the full name of a folder, or the name of a video without its suffix."""
    place = capture.resolve()
    return place.name if place.is_dir() else place.stem


@dataclass(frozen=True)
class Sample:
    """A capture and a seed, from which all variants are made."""

    capture: Path
    seed: int
    reference: Path | None
    """Reference images that the user gave; None for the capture's truth or held-out frames."""
    label: str = ""
    """Name in tables; empty for that of the capture."""

    @property
    def name(self) -> str:
        return f"{self.label or self.capture.resolve().name}-{self.seed}"

    @property
    def column(self) -> str:
        """Protocol of a synthetic capture, or the name of a real one."""
        try:
            note = read_json(self.capture / "truth" / "capture.json")
            return str(note["protocol"])
        except (OSError, ValueError, KeyError, TypeError):
            return self.label or capture_name(self.capture)


@dataclass(frozen=True)
class SceneRecipe:
    """Settings that all runs of a comparison share."""

    dag: Stages
    workflow: str
    overrides: tuple[str, ...]
    device: Device
    threads: int
    options: EvalOptions
    steps: int | None = None
    """Training steps of each variant; None for those of the whole method with the recipe."""

    @cached_property
    def weights(self) -> dict[str, str]:
        """Digests of the weights of all metrics that are available now."""
        from cleargs.evaluate.metrics import load_metrics

        return dict(load_metrics(self.options).weights)


@dataclass
class ChargedStages:
    """Stages of a sample whose time is already charged to a variant."""

    keys: set[str] = field(default_factory=set)

    def charge(self, manifests: Sequence[Manifest]) -> tuple[float, float]:
        """Charge stages; return the seconds of those that were not charged before, and of the others."""
        new = [manifest for manifest in manifests if manifest.key not in self.keys]
        self.keys.update(manifest.key for manifest in new)
        own = sum(manifest.seconds for manifest in new)
        return own, sum(manifest.seconds for manifest in manifests) - own


@dataclass(frozen=True)
class FinishedScene:
    """A finished scene of one variant of one sample."""

    sample: Sample
    variant: Variant
    run: Path
    seconds: float
    shared_seconds: float
    manifests: tuple[Manifest, ...]
    """Manifests of all stages up to that of the scene."""

    @property
    def scene(self) -> Path:
        return self.run / self.variant.stage / "scene.ply"


def make_scenes(
    out: Path,
    samples: Sequence[Sample],
    variants: Sequence[Variant],
    recipe: SceneRecipe,
    store: Store,
    reporter: Reporter,
) -> Iterator[FinishedScene | str]:
    """Train every variant on every sample.

    A failed variant does not stop the others.

    Args:
        out: Folder of the comparison.
        samples: Captures with seeds.
        variants: Variants to train on each sample.
        recipe: Settings that all runs share.
        store: Store of the runs.
        reporter: Receives progress and warnings.

    Yields:
        Each scene as soon as it is finished, or a line with the reason why it is missing.

    Raises:
        InputError: A sample has no reference to compare with. It is raised before any run starts.
    """
    for sample in samples:
        _require_reference(sample, load_config(recipe.dag, recipe.workflow, recipe.overrides, sample.seed))
    for sample in samples:
        charged, work = ChargedStages(), None
        for variant in variants:
            reporter.info(f"{sample.name}, {variant.label}")
            try:
                if work is None:
                    work = _work_of(out, sample, variant, recipe, store, reporter)
                config = variant_config(
                    recipe.dag, variant, recipe.workflow, recipe.overrides, sample.seed, work
                )
                runner = _runner(out, sample, variant, config, recipe, store, reporter)
                outcomes = runner.run_until(variant.stage)
            except CleargsError as error:
                yield f"{sample.name}, {variant.label}: {error}"
                continue
            manifests = tuple(outcome.manifest for outcome in outcomes)
            if manifests[-1].status == "partial":
                missing = ", ".join((*manifests[-1].inherited, *manifests[-1].missing))
                yield f"{sample.name}, {variant.label}: {missing}"
                continue
            finished = FinishedScene(
                sample, variant, runner.run.folder, *charged.charge(manifests), manifests
            )
            if (trained := trained_steps(finished)) != work.steps:
                reporter.warn(
                    f"{sample.name}, {variant.label}: {trained} of {work.steps} steps, because no repair "
                    "was accepted for distillation"
                )
            yield finished


def _runner(
    out: Path,
    sample: Sample,
    variant: Variant,
    config: Config,
    recipe: SceneRecipe,
    store: Store,
    reporter: Reporter,
) -> Runner:
    folder = out / sample.name / variant.name
    run = RunSpec(folder, sample.capture.absolute(), config, store.root, recipe.device)
    return Runner(recipe.dag, run, store, recipe.threads, reporter)


def _work_of(
    out: Path, sample: Sample, variant: Variant, recipe: SceneRecipe, store: Store, reporter: Reporter
) -> EqualWork:
    """Choose the work of all variants of a sample; ``variant`` is the first and runs the ingest."""
    config = load_config(recipe.dag, recipe.workflow, recipe.overrides, sample.seed)
    runner = _runner(out, sample, variant, config, recipe, store, reporter)
    return decide_work(config, runner.run_until("ingest")[-1].folder, recipe.steps)


def evaluate_views(
    out: Path, finished: FinishedScene, recipe: SceneRecipe, store: Store, reporter: Reporter
) -> list[Cell]:
    """Evaluate a scene on all sets of views.

    Args:
        out: Folder of the comparison.
        finished: The scene.
        recipe: Settings that all runs share.
        store: Store of the runs.
        reporter: Receives progress.

    Returns:
        One cell per set of views.

    Raises:
        InputError: There is no reference to compare with.
    """
    cells = []
    gaussians = read_ply(finished.scene).gaussians
    for view_set in view_sets(finished):
        evaluation, folder = cached_evaluation(out, finished, view_set, recipe, store, reporter)
        cells.append(
            Cell(
                column=finished.sample.column,
                sample=finished.sample.name,
                variant=finished.variant.name,
                views=view_set.views,
                means=compared_means(finished.scene, evaluation),
                images=len(evaluation.images),
                trained_on=_trained_on(finished, view_set),
                seconds=finished.seconds,
                shared_seconds=finished.shared_seconds,
                gaussians=gaussians.num,
                steps=trained_steps(finished),
                sh_degree=gaussians.sh_degree,
                cpu_seconds=_combine_complete(sum, [manifest.cpu_seconds for manifest in finished.manifests]),
                peak_memory_gb=_combine_complete(
                    max, [manifest.peak_memory_gb for manifest in finished.manifests]
                ),
                evaluation=folder.relative_to(out).as_posix(),
            )
        )
    return cells


def compared_means(scene: Path, evaluation: Evaluation) -> dict[str, float | None]:
    """Return metric -> mean of an evaluation: as the cameras took the frames, if this is known and fair.

    A scene that was trained with image formation does not have the motion that held-out frames have. A scene
    that was trained without it has learned that motion, and is compared without it.
    """
    trained_with_it = SceneFolder(scene.parent).formation_rows()
    return evaluation.means | (evaluation.formed if trained_with_it else {})


def _trained_on(finished: FinishedScene, view_set: ReferenceSet) -> int | None:
    """Return the number of views that show frames of the training; None if unknown."""
    from cleargs.evaluate.references import reference_of, views_trained_on

    reference = reference_of(
        finished.run,
        view_set.directory,
        poses=view_set.poses,
        align=view_set.align,
        reporter=SilentReporter(),
    )
    return views_trained_on(finished.run, finished.variant.stage, reference)


@dataclass(frozen=True)
class ReferenceSet:
    """Reference images of one set of views."""

    views: ViewSet
    directory: Path | None
    """Folder of the images; None for the frames that the run held out."""
    poses: Literal["reference", "given"] = "reference"
    align: Path | None = None
    """References of the run's frames, to align the worlds if ``directory`` shows other views."""


def view_sets(finished: FinishedScene) -> list[ReferenceSet]:
    """Return all sets of views for a scene; raise InputError if there is none."""
    truth = finished.sample.capture / "truth"
    observed, novel = truth / "observed", truth / "novel"
    if finished.sample.reference is not None:
        return [ReferenceSet("reference", finished.sample.reference)]
    if (observed / "transforms.json").is_file():
        sets = [ReferenceSet("observed", observed)]
        if _matrices(observed) != _matrices(finished.sample.capture):
            sets.append(ReferenceSet("given", observed, "given"))
        if (novel / "transforms.json").is_file():
            sets.append(ReferenceSet("novel", novel, align=observed))
        return sets
    if read_toml(finished.run / RUN_FILE)["ingest"].get("holdout", "none") != "none":
        return [ReferenceSet("held-out", None)]
    raise _without_reference(finished.sample)


def _require_reference(sample: Sample, config: Config) -> None:
    """Raise InputError if `view_sets` would find no reference; it needs no run."""
    ingest: Any = config.sections["ingest"]
    truth = sample.capture / "truth" / "observed" / "transforms.json"
    if sample.reference is None and ingest.holdout == "none" and not truth.is_file():
        raise _without_reference(sample)


def _without_reference(sample: Sample) -> InputError:
    return InputError(
        f"{sample.capture} has no sharp truth to compare with",
        hint="give --reference DIR, or hold frames out: --set ingest.holdout=sharpest:8",
    )


def cached_evaluation(
    out: Path,
    finished: FinishedScene,
    view_set: ReferenceSet,
    recipe: SceneRecipe,
    store: Store,
    reporter: Reporter,
) -> tuple[Evaluation, Path]:
    """Return the evaluation of a scene on a set of views, and its folder with the renders.

    An earlier evaluation is reused if nothing changed. The digests of the metrics' weights are compared too,
    because some weights may have been installed since.
    """
    from cleargs.evaluate.evaluate import evaluate_scene
    from cleargs.evaluate.references import reference_of

    ingest = linked_manifest(finished.run, "ingest")
    folders = (view_set.directory, view_set.align)
    parts = {
        "version": EVALUATION_VERSION,
        "scene": store.memo.digest(finished.scene.resolve()),
        "ingest": ingest.digest if ingest is not None else None,
        "references": [None if folder is None else store.memo.digests_of(folder) for folder in folders],
        "poses": view_set.poses,
        "options": recipe.options.model_dump(mode="json"),
    }
    folder = out / "evaluations" / json_digest(parts)
    path = folder / "eval.json"
    try:
        kept = Evaluation.model_validate_json(read_bytes(path))
        if kept.weights == recipe.weights:
            return kept, folder
    except (OSError, ValidationError):
        pass  # missing or damaged
    reference = reference_of(
        finished.run, view_set.directory, poses=view_set.poses, align=view_set.align, reporter=reporter
    )
    evaluation = evaluate_scene(
        finished.scene,
        reference,
        options=recipe.options,
        threads=recipe.threads,
        reporter=reporter,
        subject=finished.variant.name,
        save=folder,
    )
    write_bytes(path, evaluation.model_dump_json(indent=2).encode())
    return evaluation, folder


def scene_of_run(run: Path, dag: Stages, reference: Path | None) -> FinishedScene:
    """Return the last scene of a run, as a variant with the run's name; raise InputError without a scene."""
    spec = read_run_file(run, dag)
    for stage in ("consolidate", "rivr", "g0"):
        if linked_manifest(run, stage) is not None:
            variant = Variant(run.resolve().name, run.resolve().name, stage)
            sample = Sample(spec.source, spec.config.seed, reference)
            manifests = tuple(
                found for name in dag.until(stage) if (found := linked_manifest(run, name)) is not None
            )
            seconds = sum(manifest.seconds for manifest in manifests)
            return FinishedScene(sample, variant, run, seconds, 0.0, manifests)
    raise InputError(f"{run} has no scene yet", hint=f"first: cleargs run INPUT -o {run}")


def trained_steps(finished: FinishedScene) -> int:
    """Count the rows in the logs of all trainings of a scene; raise StoreError if a log is damaged."""
    from pyarrow import parquet

    logs = [finished.run / manifest.stage / "train.parquet" for manifest in finished.manifests]
    steps = 0
    for log in filter(Path.is_file, logs):
        with read_errors(log):
            steps += parquet.read_metadata(log).num_rows
    return steps


def _combine_complete(
    combine: Callable[[list[float]], float], values: Sequence[float | None]
) -> float | None:
    """Combine ``values``; None if one is missing."""
    known = [value for value in values if value is not None]
    return combine(known) if known and len(known) == len(values) else None


def _matrices(folder: Path) -> list[Any]:
    """Return the poses in ``transforms.json``; an empty list without the file."""
    try:
        frames = read_json(folder / "transforms.json")["frames"]
        return [frame.get("transform_matrix") for frame in frames]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return []
