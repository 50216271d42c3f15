"""The question to the model, and its reply as cues: strictly what the schema says, or what is wrong with it.
Nothing is clipped, filled in or guessed.

The text is frozen under `VERSION`, which enters the stage's key and the table: whoever changes a word raises
it here and in `QwenConfig.prompt`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from cleargs.rva.arrays import Floats
from cleargs.rva.tables import B_CUES, R_CUES

VERSION = 1

CUES = R_CUES + B_CUES
"""Keys of a reply, in the order of `tables.CUE_COLUMNS`."""

STEP = 0.05
"""Scores move in steps of this: models tell no finer ones apart, and the replies form a finite language."""


@dataclass(frozen=True)
class Anchors:
    """A cue in words, and what its scores 0, 0.5 and 1 mean."""

    meaning: str
    none: str
    half: str
    full: str


ANCHORS = {
    "sharpness": Anchors(
        "how crisp edges and fine lines are at full size",
        "no edge is crisp anywhere",
        "edges are visibly soft, details of a few pixels are lost",
        "edges are as crisp as the resolution allows",
    ),
    "structure": Anchors(
        "how clearly the shapes, corners and outlines of the scene can be made out",
        "shapes dissolve into each other",
        "large shapes are clear, small ones are not",
        "every outline and corner is clear and in one place",
    ),
    "texture": Anchors(
        "how far the texture on surfaces shows what is really there",
        "texture is wiped out or invented",
        "coarse texture is kept, fine texture is lost",
        "the finest texture is kept; a truly plain surface counts as kept",
    ),
    "cleanness": Anchors(
        "freedom from noise, compression blocks, banding, ringing and other artifacts",
        "artifacts cover the image",
        "artifacts are easy to see but leave the content readable",
        "no artifact is visible",
    ),
    "exposure": Anchors(
        "how well brightness and contrast show the scene",
        "most of the image is black, blown out or without contrast",
        "bright or dark parts have lost their detail",
        "detail is visible in bright and dark parts alike",
    ),
    "motion_blur": Anchors(
        "streaks from motion of the camera or of objects, along a direction",
        "no streaks",
        "streaks of a few pixels, content still recognisable",
        "long streaks all over, details are gone",
    ),
    "defocus": Anchors(
        "blur of wrong focus, equal in all directions",
        "what should be in focus is in focus",
        "main surfaces are slightly out of focus",
        "the whole image is far out of focus",
    ),
    "ghosting": Anchors(
        "double contours or see-through copies of the same edge",
        "every edge is single",
        "faint second contours in places",
        "strong double images over most of the frame",
    ),
    "exposure_failure": Anchors(
        "clipping to white or black, flicker, or flat grey from wrong exposure",
        "nothing is clipped",
        "about a quarter of the image has lost its content to it",
        "most of the image has lost its content to it",
    ),
    "unreliable_texture": Anchors(
        "texture that would mislead a match with other views: smears, moire, reflections, made-up detail",
        "all texture belongs to the surfaces",
        "some surfaces carry texture that is not theirs",
        "most texture is not that of the surfaces",
    ),
    "artifacts": Anchors(
        "blocks, ringing, rolling-shutter wobble, stripes, dirt or other damage by camera and codec",
        "none",
        "visible in parts of the image",
        "strong all over the image",
    ),
}


def _lines(names: tuple[str, ...]) -> str:
    return "\n".join(
        f"- {name}: {a.meaning}. 0 = {a.none}; 0.5 = {a.half}; 1 = {a.full}."
        for name, a in ((name, ANCHORS[name]) for name in names)
    )


def prompt_text(*, masked: bool) -> str:
    """The question that goes with an image; ``masked``: parts of it are painted grey and do not count."""
    mask = "Flat mid-grey areas are masked out: ignore them and their borders.\n" if masked else ""
    return (
        "This is one frame of a handheld video of a static scene. Judge how far its pixels can be trusted to "
        "show the scene's appearance in a 3D reconstruction. Judge the technical quality alone, not what it "
        "shows or how pleasing it is: a plain wall in focus is sharp.\n"
        f"{mask}"
        f"Score every cue from 0 to 1 in steps of {STEP:g}; use the whole range.\n\n"
        f"Quality cues, 1 is best:\n{_lines(R_CUES)}\n\n"
        f"Degradation cues, 1 is worst:\n{_lines(B_CUES)}\n\n"
        "Answer with one JSON object of exactly these eleven keys, each with its number, and nothing else: "
        f"{', '.join(CUES)}."
    )


def reply_schema() -> dict[str, Any]:
    """JSON schema of a reply.

    Scores are an enumeration: every decoder for constrained output knows it (bounds of numbers, many do not),
    and a model without sense cannot write digits without end.
    """
    steps = round(1 / STEP)
    score = {"type": "number", "enum": [round(k / steps, 2) for k in range(steps + 1)]}
    return {
        "type": "object",
        "properties": dict.fromkeys(CUES, score),
        "required": list(CUES),
        "additionalProperties": False,
    }


class ReplyError(Exception):
    """What is wrong with a reply, in words that the model can be told. Holds no text of the reply."""


def parse_reply(text: str) -> Floats:  # [11] in [0, 1], as tables.CUE_COLUMNS
    """The cues in the one JSON object of ``text``; prose around it is passed over.

    Raises ReplyError when there is no such object, when it breaks the schema (a missing, unknown or
    non-numeric value, one outside [0, 1]), or when several objects differ.
    """
    faults, found = [], set()
    for value in _objects(text.rpartition("</think>")[2]):
        try:
            found.add(_scores(value))
        except ReplyError as fault:
            faults.append(fault)
    if len(found) > 1:
        raise ReplyError("it holds several JSON objects that differ")
    if not found:
        raise faults[-1] if faults else ReplyError("it holds no complete JSON object")
    return np.array(found.pop())


def _objects(text: str) -> Iterator[dict[str, Any]]:
    """The JSON objects in ``text`` that lie in no other, from left to right."""
    decoder = json.JSONDecoder()
    start = text.find("{")
    while start >= 0:
        try:
            value, end = decoder.raw_decode(text, start)
        except (ValueError, RecursionError):
            end = start + 1
        else:
            yield value
        start = text.find("{", end)


def _scores(value: dict[str, Any]) -> tuple[float, ...]:
    missing = [name for name in CUES if name not in value]
    if missing:
        raise ReplyError(f"it lacks {', '.join(missing)}")
    if len(value) > len(CUES):
        raise ReplyError("it has keys that were not asked for")
    for name in CUES:
        score = value[name]
        if isinstance(score, bool) or not isinstance(score, int | float):
            raise ReplyError(f"{name} is no number")
        if not 0.0 <= score <= 1.0:  # NaN included
            raise ReplyError(f"{name} lies outside [0, 1]")
    return tuple(float(value[name]) for name in CUES)
