"""Equal work: all variants of a comparison get the same training steps, budget and SH degree.

The numbers are those of the whole method with the comparison's recipe and every frame active. A variant that
ends with G0 uses all steps for G0. A variant that ends with RIVR adds the steps of consolidation to the
rounds. A variant with its own recipe keeps the proportions of that recipe.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.comparison.variants import Variant
from cleargs.errors import ConfigError
from cleargs.pipeline.config import Config, check_document, load_config, merge, parse_override, read_recipe
from cleargs.pipeline.stages import Stages


@dataclass(frozen=True)
class EqualWork:
    """Training work of each variant of a sample (a capture and a seed)."""

    steps: int
    frames: int
    """Number of frames. It determines the steps if the settings do not."""
    budget: int
    """Maximum number of Gaussians."""
    sh_degree: int


@dataclass(frozen=True)
class Steps:
    """Training steps of a scene by stage."""

    g0: int
    round: int
    """Steps of one round of RIVR."""
    rounds: int
    consolidate: int

    @property
    def total(self) -> int:
        return self.g0 + self.rounds * self.round + self.consolidate


def steps_of(config: Config, frames: int, stage: str = "consolidate") -> Steps:
    """Return the steps of a run on ``frames`` frames up to ``stage``.

    A round without an accepted repair trains less than this.
    """
    whole: Any = config.sections
    rivr, consolidate = stage != "g0", stage == "consolidate"
    return Steps(
        g0=whole["g0"].steps_for(frames),
        round=whole["rivr"].distil.applied_to(whole["g0"], frames).length if rivr else 0,
        rounds=whole["rivr"].rounds if rivr else 0,
        consolidate=whole["consolidate"].distil.applied_to(whole["g0"], frames).length if consolidate else 0,
    )


def decide_work(config: Config, ingest: Path, steps: int | None) -> EqualWork:
    """Choose the work of all variants of a capture.

    Settings that the recipe leaves open get the values of a run that trains on every registered training
    frame.

    Args:
        config: Configuration of the comparison's recipe.
        ingest: Finished ingest folder of the capture.
        steps: Total steps that the user asked for; None for those of the recipe.
    """
    from cleargs.capture.tables import load_frames
    from cleargs.splat.config import budget_from_pixels
    from cleargs.splat.initialise import sh_degree_from_views

    frames = [frame for frame in load_frames(ingest) if frame.registered and frame.split == "train"]
    g0: Any = config.sections["g0"]
    pixels = sum(frame.width * frame.height for frame in frames)
    return EqualWork(
        steps=steps or steps_of(config, len(frames)).total,
        frames=len(frames),
        budget=g0.budget or budget_from_pixels(pixels, g0.max_budget, g0.quality),
        sh_degree=sh_degree_from_views(len(frames)) if g0.sh_degree is None else g0.sh_degree,
    )


def split_steps(own: Steps, stage: str, total: int) -> Steps:
    """Split ``total`` steps between the stages up to ``stage`` in the proportions of ``own``.

    Steps of later stages go to the stages that run, and rounding errors to G0.

    Raises:
        ConfigError: A training would get no step.
    """
    if stage == "g0":
        return Steps(total, 0, 0, 0)
    each = own.round if stage == "consolidate" else own.round + own.consolidate / own.rounds
    round_ = max(1, round(total * each / own.total))
    consolidate = max(1, round(total * own.consolidate / own.total)) if stage == "consolidate" else 0
    left = total - own.rounds * round_ - consolidate
    if left < 1:
        raise ConfigError(
            f"{total} steps are too few for {own.rounds} rounds", hint="increase --steps or reduce the rounds"
        )
    return Steps(left, round_, own.rounds, consolidate)


def variant_config(
    dag: Stages,
    variant: Variant,
    recipe: str,
    overrides: Sequence[str],
    seed: int,
    work: EqualWork | None = None,
) -> Config:
    """Return the configuration of a variant.

    A variant with its own recipe still uses the ingest settings of ``recipe``, so that all variants see the
    same images. Only a variant that does not model a rolling shutter has cameras without one.

    Args:
        dag: The stages.
        variant: The variant.
        recipe: Name or file of the comparison's recipe.
        overrides: Settings for all variants, in the form of ``--set``.
        seed: Seed of the run.
        work: Work that all variants share; None to keep the settings of the recipe.

    Raises:
        ConfigError: A recipe or setting is invalid.
    """
    document = read_recipe(recipe if variant.workflow is None else variant.workflow)
    if variant.workflow is not None:
        shared = load_config(dag, recipe, overrides, seed).document()
        document = {**document, "ingest": shared["ingest"]}
    for text in (*overrides, *variant.overrides):
        document = merge(document, parse_override(text))
    document = merge(document, {"seed": seed})
    plain = check_document(dag, document)
    if work is None:
        return plain
    for text in _settings(plain, variant, work):
        document = merge(document, parse_override(text))
    return check_document(dag, document)


def _settings(plain: Config, variant: Variant, work: EqualWork) -> list[str]:
    """Return the settings that give ``variant`` equal work, with the share of the steps of each training."""
    own = steps_of(plain, work.frames)
    spent = split_steps(own, variant.stage, work.steps)
    lines = [f"g0.sh_degree={work.sh_degree}", f"g0.budget={work.budget}"]
    done = 0
    for name, steps, trainings in (
        ("g0", spent.g0, 1),
        ("rivr.distil", spent.round, spent.rounds),
        ("consolidate.distil", spent.consolidate, 1),
    ):
        if not steps:  # the stage does not run
            continue
        lines.append(f"{name}.steps={steps}")
        if done:
            lines.append(f"{name}.begin={done / spent.total}")
        done += trainings * steps
        lines.append(f"{name}.end={done / spent.total}")
    return lines
