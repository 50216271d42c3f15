"""Make the captures, scenes and comparisons behind the pages of results (together: the evidence).

``evidence.toml`` lists the fixed test set and the sections of the page. Every section is a comparison like
those of ``compare``. All sections share one folder and one store, so that an interrupted call can be resumed.
"""

from __future__ import annotations

import os
import shutil
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from benchmarks.comparison.equal_work import steps_of, variant_config
from benchmarks.comparison.findings import Comparison, compare_scenes
from benchmarks.comparison.scenes import Sample, SceneRecipe, make_scenes
from benchmarks.comparison.splat_world import scene_setup
from benchmarks.comparison.variants import find_variants
from cleargs.base_model import FrozenModel
from cleargs.errors import CleargsError, ConfigError, InputError
from cleargs.pipeline.config import load_config
from cleargs.pipeline.run_file import RunSpec
from cleargs.pipeline.runner import Runner
from cleargs.pipeline.store import Store
from cleargs.progress import Reporter
from cleargs.safe_io import FAULTS, cause, read_text
from cleargs.splat.budget import training_cost
from cleargs.synth.synthetic_capture import make_capture

WORLD_SETTINGS = (
    "rva.enabled=false",
    "g0.steps=4000",
    "g0.end=1.0",
    "g0.budget=100000",
    "ingest.max_frames=60",
)
"""Settings of a scene that is the world of synthetic captures: it uses every frame and the full schedule."""

Seed = Annotated[int, Field(ge=0)]


class TestSet(FrozenModel):
    """Captures that may not be used to choose defaults."""

    __test__ = False  # pytest must not collect it

    rooms: tuple[Seed, ...]
    protocols: tuple[str, ...]
    worlds: tuple[str, ...]
    videos: tuple[str, ...]


class TuningSet(FrozenModel):
    """Captures that may be used to choose defaults."""

    rooms_below: int = Field(ge=1)
    """Rooms with a smaller seed belong to the tuning set."""


class Section(FrozenModel):
    """A section of the page: one comparison."""

    name: str = Field(pattern=r"^[a-z][a-z0-9-]*$")
    title: str
    kind: Literal["rooms", "world", "video"]
    captures: tuple[str, ...] = ()
    """Names of real captures in the folder of captures: the worlds or the videos."""
    protocols: tuple[str, ...] = ()
    seeds: tuple[Seed, ...] = Field(min_length=1)
    frames: int = Field(ge=2)
    size: tuple[int, int]
    """Width and height in px; for a video, the larger one limits the longer side."""
    steps: int = Field(ge=1)
    factors: tuple[int, ...] = (1,)
    """Multiples of ``steps``. If there are several, each has separate columns in the tables."""
    variants: tuple[str, ...]
    settings: tuple[str, ...] = ()
    align_colour: bool = False
    """Fit the colours of each image to its reference (affine in sRGB) before measuring it. Such a section
    evaluates scenes of other sections again, so the summary of the page excludes it."""


class Evidence(FrozenModel):
    """Content of ``evidence.toml``."""

    test: TestSet
    tuning: TuningSet
    quick: tuple[Section, ...]
    full: tuple[Section, ...]

    @model_validator(mode="after")
    def _sections_use_the_test_set(self) -> Evidence:
        if min(self.test.rooms) < self.tuning.rooms_below:
            raise ValueError("a room of the test set is in the tuning set")
        for section in (*self.quick, *self.full):
            known = set(self.test.worlds if section.kind == "world" else self.test.videos)
            foreign = [
                *(set(section.captures) - known),
                *(set(section.protocols) - set(self.test.protocols)),
                *(() if section.kind == "video" else set(section.seeds) - set(self.test.rooms)),
            ]
            if foreign:
                raise ValueError(f"section {section.name}: {foreign[0]} is not in the test set")
        return self


@dataclass(frozen=True)
class CaptureEntry:
    """A capture of a section, or the reason why it is missing."""

    name: str
    """Name on the page."""
    samples: tuple[Sample, ...] = ()
    missing: str = ""


@dataclass(frozen=True)
class SectionOutcome:
    """Result of a section."""

    section: Section
    compared: Comparison | None
    """None if no scene could be made."""
    missing: tuple[str, ...]
    """Names of missing captures and scenes with the reason, one per line."""


@dataclass(frozen=True)
class EvidenceContext:
    """Folders and tools for making evidence."""

    out: Path
    captures: Path | None
    """Folder of the real captures."""
    recipe: SceneRecipe
    store: Store
    reporter: Reporter


def read_evidence(path: Path | None = None) -> Evidence:
    """Read a list of evidence, by default ``evidence.toml``; raise ConfigError if it is invalid."""
    hint = "compare it with benchmarks/comparison/evidence.toml"
    try:
        text = read_text(path or Path(__file__).with_name("evidence.toml"))
        return Evidence.model_validate(tomllib.loads(text))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise ConfigError(f"list of evidence, {place}: {first['msg']}", hint=hint) from error
    except FAULTS as error:
        raise ConfigError(f"cannot read the list of evidence: {cause(error)}", hint=hint) from error


def make_section(section: Section, context: EvidenceContext) -> SectionOutcome:
    """Make the captures and scenes of a section and evaluate the scenes."""
    missing: list[str] = []
    samples: list[Sample] = []
    for capture in _captures(section, context):
        if capture.missing:
            context.reporter.warn(f"{section.title}, {capture.name}: {capture.missing}")
            missing.append(f"{capture.name}: {capture.missing}")
        samples += capture.samples
    found = Comparison()
    for factor in section.factors if samples else ():
        recipe = replace(
            context.recipe,
            overrides=(*context.recipe.overrides, *_settings(section)),
            steps=section.steps * factor,
            options=context.recipe.options.model_copy(update={"align_colour": section.align_colour}),
        )
        made = make_scenes(
            context.out, samples, find_variants(section.variants), recipe, context.store, context.reporter
        )
        try:
            one = compare_scenes(context.out, made, recipe, context.store, context.reporter)
        except InputError as error:
            missing.append(str(error))
            continue
        found.add(one if len(section.factors) == 1 else one.in_columns(f"{factor}x"))
    return SectionOutcome(section, found if found.cells else None, (*missing, *found.failures))


def estimate_minutes(sections: Iterable[Section], context: EvidenceContext) -> list[float]:
    """Estimate the minutes of each section on two idle cores, from an empty folder.

    Work that an earlier section has done is not counted again.
    """
    done: set[object] = set()

    def is_new(*work: object) -> bool:
        known = work in done
        done.add(work)
        return not known

    return [_seconds(section, context, is_new) / 60 for section in sections]


def _seconds(section: Section, context: EvidenceContext, is_new: Callable[..., bool]) -> float:
    megapixels = section.size[0] * section.size[1] / 1e6
    variants = []
    for variant in find_variants(section.variants):
        with suppress(ConfigError):  # a variant without its recipe takes no time
            config = variant_config(context.recipe.dag, variant, context.recipe.workflow, section.settings, 0)
            g0: Any = config.sections["g0"]
            variants.append((variant, steps_of(config, section.frames), g0))
    seconds = 0.0
    columns = product(section.protocols or [""], section.captures or [""], section.seeds)
    for protocol, capture, seed in columns:
        sample = (protocol, capture, seed, section.frames, section.size, section.settings)
        seconds += _SAMPLE_S if is_new(sample) else 0.0
        for factor, (variant, own, g0) in product(section.factors, variants):
            total = section.steps * factor
            if not is_new(sample, total, variant.name):
                continue
            whole = g0.model_copy(update={"steps": total})
            training = training_cost(whole, section.frames, megapixels, g0.min_points).seconds
            if variant.stage != "g0":
                # Variants that differ only in RIVR share the first scene.
                scene = (
                    variant.workflow,
                    tuple(line for line in variant.overrides if line.startswith(("rva", "g0"))),
                )
                training *= 1.0 if is_new(sample, total, scene) else 1.0 - own.g0 / own.total
                seconds += section.frames * own.rounds * (_REPAIR_S + _REPAIR_S_PER_MP * megapixels)
            seconds += training + section.frames * (_EVALUATION_S + _EVALUATION_S_PER_MP * megapixels)
    return seconds


# Measured wall seconds on two idle cores. An evaluated frame includes its share of novel views; LPIPS with
# VGG takes most of that time. The repair times are those of RIVR's estimate. A sample includes its capture,
# poses and cues.
_EVALUATION_S, _EVALUATION_S_PER_MP = 0.05, 10.0
_REPAIR_S, _REPAIR_S_PER_MP = 0.3, 5.0
_SAMPLE_S = 8.0


def _settings(section: Section) -> tuple[str, ...]:
    """Return the settings that all variants of a section share."""
    limits = (f"ingest.max_frames={section.frames}", f"ingest.max_size={max(section.size)}")
    return (*(limits if section.kind == "video" else ()), *section.settings)


def _captures(section: Section, context: EvidenceContext) -> Iterator[CaptureEntry]:
    """Yield each capture of a section as soon as it is ready."""
    if section.kind == "video":
        for name in section.captures:
            try:
                place = _real_capture(name, context)
            except CleargsError as error:
                yield CaptureEntry(name, missing=str(error))
            else:
                yield CaptureEntry(name, tuple(Sample(place, seed, None) for seed in section.seeds))
        return
    for world in section.captures if section.kind == "world" else (None,):
        for protocol in section.protocols:
            label = protocol if world is None else f"{world}, {protocol}"
            try:
                scene = None if world is None else _world(world, context)
                places = [
                    _synthetic_capture(section, protocol, seed, world, scene, context)
                    for seed in section.seeds
                ]
            except CleargsError as error:
                yield CaptureEntry(label, missing=str(error))
            else:
                pairs = zip(places, section.seeds, strict=True)
                yield CaptureEntry(label, tuple(Sample(place, seed, None) for place, seed in pairs))


def _real_capture(name: str, context: EvidenceContext) -> Path:
    if context.captures is None:
        raise InputError("this real capture needs --captures", hint="give --captures DIR")
    if not (context.captures / name).exists():
        raise InputError(f"the folder of --captures has no {name}", hint="copy the capture into that folder")
    return context.captures / name


def _synthetic_capture(
    section: Section,
    protocol: str,
    seed: int,
    world: str | None,
    scene: Path | None,
    context: EvidenceContext,
) -> Path:
    """Return the folder of a synthetic capture; make the capture if it does not exist."""
    width, height = section.size
    parts = [protocol, *([] if world is None else [world]), f"{section.frames}x{width}x{height}", str(seed)]
    place = context.out / "captures" / "-".join(parts)
    if not place.is_dir():
        # An interrupted call must not leave a folder that looks complete.
        partial = place.with_name(f".{os.getpid()}-{place.name}")
        shutil.rmtree(partial, ignore_errors=True)
        make_capture(
            partial,
            protocol,
            frames=section.frames,
            width=width,
            height=height,
            seed=seed,
            reporter=context.reporter,
            setup=None if scene is None else scene_setup(scene, None, section.frames, width, height),
        )
        partial.rename(place)
    return place


def _world(name: str, context: EvidenceContext) -> Path:
    """Return the scene of a real capture; train it on every frame if it does not exist."""
    recipe, folder = context.recipe, context.out / "worlds" / name
    config = load_config(recipe.dag, recipe.workflow, WORLD_SETTINGS)
    run = RunSpec(folder, _real_capture(name, context).absolute(), config, context.store.root, recipe.device)
    Runner(recipe.dag, run, context.store, recipe.threads, context.reporter).run_until("g0")
    return folder / "g0" / "scene.ply"


def chosen_sections(evidence: Evidence, *, quick: bool, names: Sequence[str]) -> tuple[Section, ...]:
    """Return the sections with these names, or all without names; raise InputError for an unknown name."""
    sections = evidence.quick if quick else evidence.full
    known = [section.name for section in sections]
    for name in names:
        if name not in known:
            raise InputError(f"no section is called {name!r}", hint=f"choose among {', '.join(known)}")
    return tuple(section for section in sections if not names or section.name in names)
