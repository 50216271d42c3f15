"""Runs variants of captures over one store and judges each scene: the cells of the paper's tables.

``OUT/<capture>-<seed>/<variant>`` are ordinary run folders that share ``OUT/.store``, so that a stage which
several variants agree on is made once, and a killed comparison goes on where it stopped. Evaluations are kept
by content in ``OUT/evaluations``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from cleargs.errors import CleargsError, InputError
from cleargs.evaluate.cells import Cell, ViewSet
from cleargs.evaluate.config import EvalOptions
from cleargs.evaluate.results import Evaluation
from cleargs.evaluate.variants import Variant
from cleargs.files import write_bytes
from cleargs.pipeline.config import load_config, read_toml
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.keys import canonical_json
from cleargs.pipeline.manifest import Manifest, linked_manifest
from cleargs.pipeline.run_file import RUN_FILE, Device, Run, read_run_file
from cleargs.pipeline.runner import Runner
from cleargs.pipeline.store import Store
from cleargs.progress import Reporter

EVALUATION_VERSION = 2
"""Raised when an evaluation of equal inputs would give other figures."""


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
            note = json.loads((self.capture / "truth" / "capture.json").read_bytes())
            return str(note["protocol"])
        except (OSError, ValueError, KeyError, TypeError):
            return self.capture.resolve().stem


@dataclass(frozen=True)
class Recipe:
    """What all runs of a comparison have in common."""

    dag: Dag
    workflow: str
    overrides: tuple[str, ...]
    device: Device
    threads: int
    options: EvalOptions


@dataclass
class Ledger:
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

    @property
    def scene(self) -> Path:
        return self.run / self.variant.stage / "scene.ply"


def make_scenes(
    out: Path,
    samples: Sequence[Sample],
    variants: Sequence[Variant],
    recipe: Recipe,
    store: Store,
    reporter: Reporter,
) -> Iterator[Made | str]:
    """Each scene as soon as it is there, or the line that says why it could not be made.

    A variant that fails ends neither its sample nor the others.
    """
    for sample in samples:
        ledger = Ledger()
        for variant in variants:
            folder = out / sample.name / variant.name
            settings = (*recipe.overrides, *variant.overrides)
            config = load_config(recipe.dag, recipe.workflow, settings, sample.seed)
            run = Run(folder, sample.capture.absolute(), config, store.root, recipe.device)
            reporter.info(f"{sample.name}, {variant.label}")
            try:
                runner = Runner(recipe.dag, run, store, recipe.threads, reporter)
                outcomes = runner.run_until(variant.stage)
            except CleargsError as error:
                yield f"{sample.name}, {variant.label}: {error}"
                continue
            last = outcomes[-1].manifest
            if last.status == "partial":
                yield f"{sample.name}, {variant.label}: {', '.join((*last.inherited, *last.missing))}"
                continue
            yield Made(sample, variant, folder, *ledger.charge([outcome.manifest for outcome in outcomes]))


def judge(out: Path, made: Made, recipe: Recipe, store: Store, reporter: Reporter) -> list[Cell]:
    """The cells of one scene, one a set of views. Raises InputError when there is nothing to compare with."""
    cells = []
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
                seconds=made.seconds,
                shared_seconds=made.shared_seconds,
                gaussians=gaussians_of(made.scene),
                evaluation=folder.relative_to(out).as_posix(),
            )
        )
    return cells


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
    raise InputError(
        f"{made.sample.capture} has no sharp truth to compare with",
        hint="give --reference DIR, or hold frames out: --set ingest.holdout=sharpest:8",
    )


def evaluated(
    out: Path, made: Made, view_set: Views, recipe: Recipe, store: Store, reporter: Reporter
) -> tuple[Evaluation, Path]:
    """The evaluation of a scene on a set of views, and the folder that keeps it with the renders.

    One from an earlier call is taken where nothing changed.
    """
    from cleargs.evaluate.evaluate import evaluate_scene, reference_of

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
    folder = out / "evaluations" / hashlib.sha256(canonical_json(parts).encode()).hexdigest()
    path = folder / "eval.json"
    try:
        return Evaluation.model_validate_json(path.read_bytes()), folder
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
            manifests = [
                found for name in dag.until(stage) if (found := linked_manifest(run, name)) is not None
            ]
            return Made(sample, variant, run, sum(manifest.seconds for manifest in manifests), 0.0)
    raise InputError(f"{run} has no scene yet", hint=f"first: cleargs run INPUT -o {run}")


def gaussians_of(scene: Path) -> int:
    """The number of Gaussians in a PLY, from its header."""
    with scene.open("rb") as file:
        for line in file:
            if line.startswith(b"element vertex"):
                return int(line.split()[2])
            if line.startswith(b"end_header"):
                break
    raise InputError(f"{scene} is not a Gaussian scene", hint="make it again with `cleargs run`")


def _matrices(folder: Path) -> list[Any]:
    """The poses that ``transforms.json`` lists; none without the file."""
    try:
        frames = json.loads((folder / "transforms.json").read_bytes())["frames"]
        return [frame.get("transform_matrix") for frame in frames]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return []
