"""Equal work: every variant of a comparison trains for as many steps, with one budget and one SH degree.

The numbers are those of the whole method under the comparison's recipe, every frame active. A variant that
ends with G0 trains its G0 for all of the steps, one that ends with RIVR gives the consolidation's to its
rounds; one with a recipe of its own keeps that recipe's proportions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.comparison.variants import Variant
from cleargs.errors import ConfigError
from cleargs.pipeline.config import Config, check_document, load_config, merge, parse_override, read_recipe
from cleargs.pipeline.dag import Dag


@dataclass(frozen=True)
class EqualWork:
    """What every variant of a sample gets."""

    steps: int
    frames: int
    """On which the proportions of the trainings rest, where the settings leave their steps open."""
    budget: int
    """Most Gaussians."""
    sh_degree: int


@dataclass(frozen=True)
class Steps:
    """How the steps of a scene are spent."""

    g0: int
    round: int
    rounds: int
    """Distillations of RIVR."""
    consolidate: int

    @property
    def total(self) -> int:
        return self.g0 + self.rounds * self.round + self.consolidate


def steps_of(config: Config, frames: int, stage: str = "consolidate") -> Steps:
    """The steps that a run on so many frames makes up to ``stage``, provided that some repair is accepted in
    each round.
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
    """The work of all variants of a capture, from the finished folder of its ingest.

    ``config`` is that of the comparison's recipe, ``steps`` what the user asked for. Settings that the recipe
    leaves open are decided as they would be with every registered training frame active.
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


def split(own: Steps, stage: str, total: int) -> Steps:
    """``total`` steps in the proportions of ``own``; what a variant lacks goes to the stages that it has.

    Rounding goes to G0. Every training that is there keeps at least one step: raises ConfigError where there
    are not enough.
    """
    if stage == "g0":
        return Steps(total, 0, 0, 0)
    each = own.round if stage == "consolidate" else own.round + own.consolidate / own.rounds
    round_ = max(1, round(total * each / own.total))
    consolidate = max(1, round(total * own.consolidate / own.total)) if stage == "consolidate" else 0
    left = total - own.rounds * round_ - consolidate
    if left < 1:
        raise ConfigError(
            f"{total} steps are too few for {own.rounds} rounds", hint="give more --steps, or fewer rounds"
        )
    return Steps(left, round_, own.rounds, consolidate)


def variant_config(
    dag: Dag,
    variant: Variant,
    recipe: str,
    overrides: Sequence[str],
    seed: int,
    work: EqualWork | None = None,
) -> Config:
    """The configuration of a variant; with ``work`` equal to that of all others.

    A recipe of the variant's own decides all stages but the ingest, so that all variants see the same images
    at the same poses. Raises ConfigError.
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
    """What equal work changes; schedules run by share of the steps."""
    own = steps_of(plain, work.frames)
    spent = split(own, variant.stage, work.steps)
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
