"""The evidence for the method: what is compared on which captures, and how all of it is made.

``evidence.toml`` lists the frozen test set and the sections of the page. Every section is a comparison like
those of ``compare``, in one folder with one store, so that a killed call resumes where it stopped.
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
from benchmarks.comparison.findings import Compared, compare_scenes
from benchmarks.comparison.scenes import Sample, SceneRecipe, make_scenes
from benchmarks.comparison.splat_world import scene_setting
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
"""How a scene is trained that becomes a world: on every frame, and to the end."""

Seed = Annotated[int, Field(ge=0)]


class TestSet(FrozenModel):
    """What no default may be chosen on."""

    __test__ = False  # no test of pytest's

    rooms: tuple[Seed, ...]
    protocols: tuple[str, ...]
    worlds: tuple[str, ...]
    videos: tuple[str, ...]


class TuningSet(FrozenModel):
    """What defaults may be chosen on."""

    rooms_below: int = Field(ge=1)


class Section(FrozenModel):
    """One comparison of the page."""

    name: str = Field(pattern=r"^[a-z][a-z0-9-]*$")
    title: str
    kind: Literal["rooms", "world", "video"]
    captures: tuple[str, ...] = ()
    """Real captures below the folder of captures: the worlds, or the videos."""
    protocols: tuple[str, ...] = ()
    seeds: tuple[Seed, ...] = Field(min_length=1)
    frames: int = Field(ge=2)
    size: tuple[int, int]
    """Width and height; of a video the larger is the limit of its long side."""
    steps: int = Field(ge=1)
    factors: tuple[int, ...] = (1,)
    """Multiples of ``steps``: a column each, where there are several."""
    variants: tuple[str, ...]
    settings: tuple[str, ...] = ()
    align_colour: bool = False
    """Judge each image after the affine on sRGB that fits it to its reference best: of what other sections
    judge as it is, so none of it counts again in the page's summary."""


class Evidence(FrozenModel):
    """``evidence.toml``."""

    test: TestSet
    tuning: TuningSet
    quick: tuple[Section, ...]
    full: tuple[Section, ...]

    @model_validator(mode="after")
    def _sections_take_the_test_set(self) -> Evidence:
        if min(self.test.rooms) < self.tuning.rooms_below:
            raise ValueError("a room of the test set belongs to the tuning set")
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
    """A capture of a section, or why it cannot be made."""

    name: str
    """As the page calls it."""
    samples: tuple[Sample, ...] = ()
    missing: str = ""


@dataclass(frozen=True)
class SectionOutcome:
    """What became of a section."""

    section: Section
    compared: Compared | None
    """None where nothing of it could be made."""
    missing: tuple[str, ...]
    """What could not be made, and why, a line each."""


@dataclass(frozen=True)
class EvidenceContext:
    """Where evidence is made, and with what."""

    out: Path
    captures: Path | None
    """Folder of the real captures."""
    recipe: SceneRecipe
    store: Store
    reporter: Reporter


def read_evidence(path: Path | None = None) -> Evidence:
    """Return the lists of ``path``; for None those next to this module. Raises ConfigError where unusable."""
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
    """Make the captures of a section, all of its scenes, and judge them."""
    missing: list[str] = []
    samples: list[Sample] = []
    for capture in _captures(section, context):
        if capture.missing:
            context.reporter.warn(f"{section.title}, {capture.name}: {capture.missing}")
            missing.append(f"{capture.name}: {capture.missing}")
        samples += capture.samples
    found = Compared()
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


def minutes(sections: Iterable[Section], context: EvidenceContext) -> list[float]:
    """Rough time of each section on two quiet cores, everything still to be made; what a section before it
    has made takes no time.
    """
    made: set[object] = set()

    def first(*what: object) -> bool:
        known = what in made
        made.add(what)
        return not known

    return [_seconds(section, context, first) / 60 for section in sections]


def _seconds(section: Section, context: EvidenceContext, first: Callable[..., bool]) -> float:
    megapixels = section.size[0] * section.size[1] / 1e6
    variants = []
    for variant in find_variants(section.variants):
        with suppress(ConfigError):  # its recipe is not there: it takes no time
            config = variant_config(context.recipe.dag, variant, context.recipe.workflow, section.settings, 0)
            g0: Any = config.sections["g0"]
            variants.append((variant, steps_of(config, section.frames), g0))
    seconds = 0.0
    columns = product(section.protocols or [""], section.captures or [""], section.seeds)
    for protocol, capture, seed in columns:
        sample = (protocol, capture, seed, section.frames, section.size, section.settings)
        seconds += _SAMPLE_S if first(sample) else 0.0
        for factor, (variant, own, g0) in product(section.factors, variants):
            total = section.steps * factor
            if not first(sample, total, variant.name):
                continue
            whole = g0.model_copy(update={"steps": total})
            training, _ = training_cost(whole, section.frames, megapixels, g0.min_points)
            if variant.stage != "g0":
                # Those that differ in RIVR alone share the first scene.
                scene = (
                    variant.workflow,
                    tuple(line for line in variant.overrides if line.startswith(("rva", "g0"))),
                )
                training *= 1.0 if first(sample, total, scene) else 1.0 - own.g0 / own.total
                seconds += section.frames * own.rounds * (_REPAIR_S + _REPAIR_S_PER_MP * megapixels)
            seconds += training + section.frames * (_JUDGE_S + _JUDGE_S_PER_MP * megapixels)
    return seconds


# Wall seconds on two quiet cores: a part a unit and a part a megapixel. A judged frame, views off the path
# included: nearly all of it LPIPS with VGG. A repair: as RIVR estimates. A sample: its capture, poses and
# cues.
_JUDGE_S, _JUDGE_S_PER_MP = 0.05, 10.0
_REPAIR_S, _REPAIR_S_PER_MP = 0.3, 5.0
_SAMPLE_S = 8.0


def _settings(section: Section) -> tuple[str, ...]:
    """What holds for all variants of a section."""
    limits = (f"ingest.max_frames={section.frames}", f"ingest.max_size={max(section.size)}")
    return (*(limits if section.kind == "video" else ()), *section.settings)


def _captures(section: Section, context: EvidenceContext) -> Iterator[CaptureEntry]:
    """The captures of a section as soon as they are there."""
    if section.kind == "video":
        for name in section.captures:
            try:
                place = _real(name, context)
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
                    _synthetic(section, protocol, seed, world, scene, context) for seed in section.seeds
                ]
            except CleargsError as error:
                yield CaptureEntry(label, missing=str(error))
            else:
                pairs = zip(places, section.seeds, strict=True)
                yield CaptureEntry(label, tuple(Sample(place, seed, None) for place, seed in pairs))


def _real(name: str, context: EvidenceContext) -> Path:
    if context.captures is None:
        raise InputError("it is a real capture, and --captures was not given", hint="give --captures DIR")
    if not (context.captures / name).exists():
        raise InputError(f"the folder of --captures holds no {name}", hint="put it there")
    return context.captures / name


def _synthetic(
    section: Section,
    protocol: str,
    seed: int,
    world: str | None,
    scene: Path | None,
    context: EvidenceContext,
) -> Path:
    """The folder of a synthetic capture, made where it is not there yet."""
    width, height = section.size
    parts = [protocol, *([] if world is None else [world]), f"{section.frames}x{width}x{height}", str(seed)]
    place = context.out / "captures" / "-".join(parts)
    if not place.is_dir():
        beside = place.with_name(
            f".{os.getpid()}-{place.name}"
        )  # a killed maker leaves nothing that looks done
        shutil.rmtree(beside, ignore_errors=True)
        make_capture(
            beside,
            protocol,
            frames=section.frames,
            width=width,
            height=height,
            seed=seed,
            reporter=context.reporter,
            setting=None if scene is None else scene_setting(scene, None, section.frames, width, height),
        )
        beside.rename(place)
    return place


def _world(name: str, context: EvidenceContext) -> Path:
    """The scene of a real capture, trained on every frame where it is not there yet."""
    recipe, folder = context.recipe, context.out / "worlds" / name
    config = load_config(recipe.dag, recipe.workflow, WORLD_SETTINGS)
    run = RunSpec(folder, _real(name, context).absolute(), config, context.store.root, recipe.device)
    Runner(recipe.dag, run, context.store, recipe.threads, context.reporter).run_until("g0")
    return folder / "g0" / "scene.ply"


def chosen_sections(evidence: Evidence, *, quick: bool, names: Sequence[str]) -> tuple[Section, ...]:
    """The sections to make. Raises InputError for an unknown name."""
    sections = evidence.quick if quick else evidence.full
    known = [section.name for section in sections]
    for name in names:
        if name not in known:
            raise InputError(f"there is no section {name!r}", hint=f"choose among {', '.join(known)}")
    return tuple(section for section in sections if not names or section.name in names)
