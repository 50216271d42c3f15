"""The advice of a report: commands that may improve the result, with their expected time and gain.

The gains in dB were measured at held-out frames of real captures (docs/experiments/speed.md). Advice without
a measured gain is ordered by judgement.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import tomli_w

from cleargs.capture.summary import IngestSummary
from cleargs.errors import CleargsError
from cleargs.manifest import Manifest
from cleargs.pipeline.config import Config, load_config, recipe_names
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import RunSpec
from cleargs.pipeline.settings import flattened
from cleargs.pipeline.stages import Stages
from cleargs.program import program
from cleargs.progress import SilentReporter
from cleargs.report.formatting import count
from cleargs.report.frames import HELD_OUT, UNPLACED, FrameRow
from cleargs.report.outcome import short_training
from cleargs.rivr.summaries import G0Summary
from cleargs.splat.config import STEPS_FACTOR

FEW_PLACED = 0.8
"""Share of frames with a pose below which the report gives advice on the other frames."""
BLURRED_PX = 6.0
"""Motion blur above which a frame counts as blurred, px."""
NO_FIGURE = "not measured"


class Advice(NamedTuple):
    """Something that may improve the result."""

    what: str
    why: str
    gain: str
    worth: float
    """Rank of the advice, largest first: the expected gain in dB, or a value chosen by judgement."""
    options: tuple[str, ...] = ()
    """Options of ``cleargs run``; empty if no command helps."""
    command: str = ""
    time: str = ""
    """Expected time of the command; "" without a command or an estimate."""


def shown_advice(
    planner: Planner, manifests: Mapping[str, Manifest], rows: Sequence[FrameRow]
) -> list[Advice]:
    """Return advice on a run, the most useful first. Holding frames out is never the only advised command."""
    found = [
        Advice(f"{manifest.stage} is incomplete", missing, "", 9.0)
        for manifest in manifests.values()
        for missing in manifest.missing
    ]
    found += _on_frames(planner.run.config, manifests, rows)
    if "g0" in manifests:
        found += _on_training(planner, manifests, rows)
    found.sort(key=lambda advice: -advice.worth)
    if not any(advice.options and advice.worth for advice in found):
        found = [advice for advice in found if advice.worth]
    return [
        advice._replace(
            command=_command(planner.run, advice.options), time=_time(planner, advice.options, manifests)
        )
        if advice.options
        else advice
        for advice in found
    ]


def command(run: RunSpec, dag: Stages) -> str:
    """Return the ``cleargs run`` command that reproduces a run, as called in the parent of its folder."""
    recipe, changed = _nearest_recipe(run.config, dag)
    words = ["--recipe", recipe] if recipe != "default" else []
    words += ["--seed", str(changed.pop("seed"))] if "seed" in changed else []
    return _command(run, words + _set(changed))


def _command(run: RunSpec, options: Sequence[str]) -> str:
    """Return the command ``cleargs run`` with ``options``, as called in the parent of the run folder."""
    place = run.folder.parent
    words = ["run", os.path.relpath(run.source, place), "-o", run.folder.name, *options]
    return f"{program(place)} {shlex.join(words)}"


def _nearest_recipe(config: Config, dag: Stages) -> tuple[str, dict[str, Any]]:
    """Return the recipe from which the fewest settings differ, and these settings."""
    settings = dict(flattened(config.document()))
    candidates = []
    for recipe in ("default", *(name for name in recipe_names() if name != "default")):
        from_recipe = dict(flattened(load_config(dag, recipe).document()))
        changed = {name: value for name, value in settings.items() if from_recipe.get(name) != value}
        candidates.append((len(changed), recipe, changed))
    _, recipe, changed = min(candidates, key=lambda item: item[0])
    return recipe, changed


def _set(values: Mapping[str, Any]) -> list[str]:
    """Return options ``--set NAME=VALUE``."""
    words = []
    for name, value in values.items():
        words += ["--set", f"{name}={value if isinstance(value, str) else toml_text(value)}"]
    return words


def toml_text(value: Any) -> str:
    """Return ``value`` in TOML, or "unset" for None."""
    if value is None:
        return "unset"
    return " ".join(tomli_w.dumps({"v": value}).removeprefix("v = ").split())


def _time(planner: Planner, options: Sequence[str], manifests: Mapping[str, Manifest]) -> str:
    """Return the expected time of the run with ``options``, by that of the run; "" if it is unknown."""
    given = [
        f"g0.quality={value}" if option == "--quality" else value
        for option, value in pairwise(options)
        if option in ("--set", "--quality")
    ]
    kept = "default" if "--reset" in options else planner.run.config.document()
    try:
        run = replace(planner.run, config=load_config(planner.dag, kept, given))
        changed = Planner(planner.dag, run, planner.store, planner.threads, SilentReporter())
        costs = [plan.estimate.minutes for plan in changed.plan() if plan.estimate is not None]
        minutes = sum(costs) * planner.pace_of(manifests)
    except CleargsError:  # the capture was deleted or moved
        return ""
    return f"about {max(1, round(minutes))} min" if costs else ""


def _on_frames(
    config: Config, manifests: Mapping[str, Manifest], rows: Sequence[FrameRow]
) -> Iterator[Advice]:
    ingest: Any = config.sections["ingest"]
    g0: Any = config.sections.get("g0")  # a pipeline of other stages may have none
    unplaced = sum(row.role == UNPLACED for row in rows)
    available = IngestSummary.of(manifests.get("ingest")).frames_available or 0
    more: dict[str, Any] = {}  # the setting that limits the number of frames, if the capture has more
    if available > len(rows) and not (g0 and g0.quality == "draft"):
        if ingest.fps is not None and len(rows) < ingest.max_frames:
            more = {"ingest.fps": 2 * ingest.fps}
        else:
            more = {"ingest.max_frames": min(available, 2 * len(rows))}
    if rows and unplaced > (1.0 - FEW_PLACED) * len(rows):
        all_pairs = len(rows) < ingest.exhaustive_below
        overlap = {} if all_pairs else {"ingest.overlap": 2 * ingest.overlap}
        yield Advice(
            f"{count(unplaced, 'frame has', 'frames have')} no pose",
            "They share too few points with their neighbours: they are too blurred or too far apart.",
            f"up to {count(unplaced, 'frame')} more" if more or overlap else "",
            5.0,
            tuple(_set(more | overlap)),
        )
    elif more and available > 1.5 * len(rows):
        yield Advice(
            f"{len(rows)} of {available} frames were used",
            "More frames show each surface from more views.",
            "+1.8 dB at new views on one capture (292 frames in place of 150)",
            1.0,
            tuple(_set(more)),
        )
    if rows and not any(row.role == HELD_OUT for row in rows):
        yield Advice(
            "No frame was held out",
            "The PSNR at the top is for other pixels of the frames that the scene was trained on. "
            "New views are worse; no figure here says by how much.",
            "no better scene, but a figure for new views",
            0.0,
            ("--set", "ingest.holdout=every:8"),
        )
    blurred = sum((row.motion("blur_px") or 0.0) > BLURRED_PX for row in rows)
    if blurred > len(rows) / 2:
        what = f"{count(blurred, 'frame has', 'frames have')} more than {BLURRED_PX:g} px of motion blur"
        why = "A shorter exposure or slower camera motion gives sharper frames than any repair."
        yield Advice(what, why, NO_FIGURE, 0.5)


def _on_training(
    planner: Planner, manifests: Mapping[str, Manifest], rows: Sequence[FrameRow]
) -> Iterator[Advice]:
    config = planner.run.config
    g0: Any = config.sections["g0"]
    ingest: Any = config.effective["ingest"]
    size = ingest.max_size
    recipe, changed = _nearest_recipe(config, planner.dag)
    named = g0.steps is not None or recipe != "default"
    if short := short_training(manifests, rows):
        own = {name: value for name, value in changed.items() if name.startswith(("ingest.", "rva."))}
        reset = ("--reset", *_set(own)) if named else ()
        yield Advice(
            f"The training was short: {short[0]:,} of {short[1]:,} steps at {size} px",
            "Longer training gives finer detail.",
            "+0.8 to 2.2 dB at new views (draft against standard, four captures)",
            1.5,
            (*reset, "--quality", "standard"),
        )
    elif g0.quality == "standard" and not named:
        yield Advice(
            "The training can be longer",
            f"High quality takes {STEPS_FACTOR['high']:.0f} times the steps and twice the Gaussians.",
            "+0.4 to 0.9 dB at new views on three captures, none on a fourth, -1.1 dB on a blurred one",
            0.6,
            ("--quality", "high"),
        )
    if not short and any(size in (row.frame.width, row.frame.height) for row in rows):
        why = "Larger images show finer detail, if the video has it."
        larger = tuple(_set({"ingest.max_size": size * 3 // 2}))
        yield Advice(f"Images were reduced to {size} px", why, NO_FIGURE, 0.5, larger)
    trained = G0Summary.of(manifests.get("g0"))
    for what, spread, most in (
        ("Exposure differs", trained.exposure_spread or 0.0, g0.exposure_threshold),
        ("White balance differs", trained.colour_spread or 0.0, g0.colour_threshold),
    ):
        if spread > most and not trained.exposure:
            why = "Without compensation the scene averages the colours, which causes floating haze."
            remedy = tuple(_set({"g0.exposure": "on"}))
            yield Advice(f"{what} by {100 * spread:.0f} % between frames", why, NO_FIGURE, 0.8, remedy)
