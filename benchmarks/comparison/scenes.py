"""Runs variants of captures over one store and judges each scene: the cells of the paper's tables.

``OUT/<capture>-<seed>/<variant>`` are ordinary run folders that share ``OUT/.store``, so that a stage which
several variants agree on is made once, and a killed comparison resumes where it stopped. Evaluations are kept
by content in ``OUT/evaluations``.
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
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.run_file import RUN_FILE, Device, RunSpec, read_run_file
from cleargs.pipeline.runner import Runner
from cleargs.pipeline.store import Store
from cleargs.progress import Reporter, SilentReporter
from cleargs.safe_io import read_bytes, read_json
from cleargs.splat.ply import read_ply

EVALUATION_VERSION = 3
"""Raised when an evaluation of equal inputs would give other figures."""


def capture_name(capture: Path) -> str:
    """The name of a folder, dots and all, or of a video without its suffix."""
    place = capture.resolve()
    return place.name if place.is_dir() else place.stem


@dataclass(frozen=True)
class Sample:
    """A capture and a seed: what all variants are made from."""

    capture: Path
    seed: int
    reference: Path | None
    """A reference that the user named; None: the capture's own truth or held-out frames."""

    @property
    def name(self) -> str:
        return f"{self.capture.resolve().name}-{self.seed}"

    @property
    def column(self) -> str:
        """The protocol of a synthetic capture, else the name of the capture."""
        try:
            note = read_json(self.capture / "truth" / "capture.json")
            return str(note["protocol"])
        except (OSError, ValueError, KeyError, TypeError):
            return capture_name(self.capture)


@dataclass(frozen=True)
class SceneRecipe:
    """What all runs of a comparison have in common."""

    dag: Dag
    workflow: str
    overrides: tuple[str, ...]
    device: Device
    threads: int
    options: EvalOptions
    steps: int | None = None
    """Training steps of every variant; None: those of the whole method under the recipe."""

    @cached_property
    def weights(self) -> dict[str, str]:
        """Digests of the weights of the metrics that can be had now."""
        from cleargs.evaluate.metrics import load_metrics

        return dict(load_metrics(self.options).weights)


@dataclass
class ChargedStages:
    """Which stages of a sample are made and paid for."""

    keys: set[str] = field(default_factory=set)

    def charge(self, manifests: Sequence[Manifest]) -> tuple[float, float]:
        """Seconds of the stages that are new to the ledger, and of the others."""
        new = [manifest for manifest in manifests if manifest.key not in self.keys]
        self.keys.update(manifest.key for manifest in new)
        own = sum(manifest.seconds for manifest in new)
        return own, sum(manifest.seconds for manifest in manifests) - own


@dataclass(frozen=True)
class Made:
    """A finished scene of one variant of one sample."""

    sample: Sample
    variant: Variant
    run: Path
    seconds: float
    shared_seconds: float
    manifests: tuple[Manifest, ...]
    """Of all stages up to the scene's."""

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
) -> Iterator[Made | str]:
    """Each scene as soon as it is there, or the line that says why it could not be made.

    A variant that fails ends neither its sample nor the others. Raises InputError, before anything is made,
    for a sample that nothing could be compared with.
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
                lacking = ", ".join((*manifests[-1].inherited, *manifests[-1].missing))
                yield f"{sample.name}, {variant.label}: {lacking}"
                continue
            made = Made(sample, variant, runner.run.folder, *charged.charge(manifests), manifests)
            if (trained := trained_steps(made)) != work.steps:
                reporter.warn(
                    f"{sample.name}, {variant.label}: {trained} of {work.steps} steps, since no repair was "
                    "accepted that could be distilled"
                )
            yield made


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
    """What all variants of a sample get, from its ingest, which is made in the run of the first of them."""
    config = load_config(recipe.dag, recipe.workflow, recipe.overrides, sample.seed)
    runner = _runner(out, sample, variant, config, recipe, store, reporter)
    return decide_work(config, runner.run_until("ingest")[-1].folder, recipe.steps)


def judge(out: Path, made: Made, recipe: SceneRecipe, store: Store, reporter: Reporter) -> list[Cell]:
    """The cells of one scene, one a set of views. Raises InputError when there is nothing to compare with."""
    cells = []
    gaussians = read_ply(made.scene).gaussians
    for view_set in view_sets(made):
        evaluation, folder = evaluated(out, made, view_set, recipe, store, reporter)
        cells.append(
            Cell(
                column=made.sample.column,
                sample=made.sample.name,
                variant=made.variant.name,
                views=view_set.views,
                means=evaluation.means,
                images=len(evaluation.images),
                trained_on=_trained_on(made, view_set),
                seconds=made.seconds,
                shared_seconds=made.shared_seconds,
                gaussians=gaussians.num,
                steps=trained_steps(made),
                sh_degree=gaussians.sh_degree,
                cpu_seconds=_all_noted(sum, [manifest.cpu_seconds for manifest in made.manifests]),
                peak_memory_gb=_all_noted(max, [manifest.peak_memory_gb for manifest in made.manifests]),
                evaluation=folder.relative_to(out).as_posix(),
            )
        )
    return cells


def _trained_on(made: Made, view_set: Views) -> int | None:
    """How many of the views show frames that the scene was trained on; None where that is not known."""
    from cleargs.evaluate.references import reference_of, views_trained_on

    reference = reference_of(
        made.run, view_set.directory, poses=view_set.poses, align=view_set.align, reporter=SilentReporter()
    )
    return views_trained_on(made.run, made.variant.stage, reference)


@dataclass(frozen=True)
class Views:
    """Where a scene can be judged."""

    views: ViewSet
    directory: Path | None
    """Folder of the references; None: the frames that the run held out."""
    poses: Literal["reference", "given"] = "reference"
    align: Path | None = None
    """References of the run's own frames, by which worlds are aligned where ``directory`` shows others."""


def view_sets(made: Made) -> list[Views]:
    """All that the scene can be judged on. Raises InputError when there is nothing."""
    truth = made.sample.capture / "truth"
    observed, novel = truth / "observed", truth / "novel"
    if made.sample.reference is not None:
        return [Views("reference", made.sample.reference)]
    if (observed / "transforms.json").is_file():
        sets = [Views("observed", observed)]
        if _matrices(observed) != _matrices(made.sample.capture):
            sets.append(Views("given", observed, "given"))
        if (novel / "transforms.json").is_file():
            sets.append(Views("novel", novel, align=observed))
        return sets
    if read_toml(made.run / RUN_FILE)["ingest"].get("holdout", "none") != "none":
        return [Views("held-out", None)]
    raise _without_reference(made.sample)


def _require_reference(sample: Sample, config: Config) -> None:
    """Raise InputError where `view_sets` would find nothing, before there is a run."""
    ingest: Any = config.sections["ingest"]
    truth = sample.capture / "truth" / "observed" / "transforms.json"
    if sample.reference is None and ingest.holdout == "none" and not truth.is_file():
        raise _without_reference(sample)


def _without_reference(sample: Sample) -> InputError:
    return InputError(
        f"{sample.capture} has no sharp truth to compare with",
        hint="give --reference DIR, or hold frames out: --set ingest.holdout=sharpest:8",
    )


def evaluated(
    out: Path, made: Made, view_set: Views, recipe: SceneRecipe, store: Store, reporter: Reporter
) -> tuple[Evaluation, Path]:
    """The evaluation of a scene on a set of views, and the folder that keeps it with the renders.

    One from an earlier call is taken where nothing changed, the weights of the metrics included: those that
    were not installed then may be now.
    """
    from cleargs.evaluate.evaluate import evaluate_scene
    from cleargs.evaluate.references import reference_of

    ingest = linked_manifest(made.run, "ingest")
    folders = (view_set.directory, view_set.align)
    parts = {
        "version": EVALUATION_VERSION,
        "scene": store.memo.digest(made.scene.resolve()),
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
        pass  # not made yet, or damaged
    reference = reference_of(
        made.run, view_set.directory, poses=view_set.poses, align=view_set.align, reporter=reporter
    )
    evaluation = evaluate_scene(
        made.scene,
        reference,
        options=recipe.options,
        threads=recipe.threads,
        reporter=reporter,
        subject=made.variant.name,
        save=folder,
    )
    write_bytes(path, evaluation.model_dump_json(indent=2).encode())
    return evaluation, folder


def existing(run: Path, dag: Dag, reference: Path | None) -> Made:
    """The last scene of a finished run, as a variant of its own name. Raises InputError when it has none."""
    noted = read_run_file(run, dag)
    for stage in ("consolidate", "rivr", "g0"):
        if linked_manifest(run, stage) is not None:
            variant = Variant(run.resolve().name, run.resolve().name, stage)
            sample = Sample(noted.source, noted.config.seed, reference)
            manifests = tuple(
                found for name in dag.until(stage) if (found := linked_manifest(run, name)) is not None
            )
            seconds = sum(manifest.seconds for manifest in manifests)
            return Made(sample, variant, run, seconds, 0.0, manifests)
    raise InputError(f"{run} has no scene yet", hint=f"first: cleargs run INPUT -o {run}")


def trained_steps(made: Made) -> int:
    """The steps behind a scene: the rows of the logs of all its trainings. Raises StoreError."""
    from pyarrow import parquet

    logs = [made.run / manifest.stage / "train.parquet" for manifest in made.manifests]
    steps = 0
    for log in filter(Path.is_file, logs):
        with read_errors(log):
            steps += parquet.read_metadata(log).num_rows
    return steps


def _all_noted(combine: Callable[[list[float]], float], values: Sequence[float | None]) -> float | None:
    """The combined values; None where one is missing."""
    known = [value for value in values if value is not None]
    return combine(known) if known and len(known) == len(values) else None


def _matrices(folder: Path) -> list[Any]:
    """The poses that ``transforms.json`` lists; none without the file."""
    try:
        frames = read_json(folder / "transforms.json")["frames"]
        return [frame.get("transform_matrix") for frame in frames]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return []
