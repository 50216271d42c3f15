"""The question to the model, and its reply as cues: strictly what the schema says, or what is wrong with it.
Nothing is clipped, filled in or guessed.

The text in ``prompt.txt`` is frozen under `QwenConfig.prompt`, which enters the stage's key and the table:
whoever changes a word raises it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cleargs.rva.tables import B_CUES, R_CUES
from cleargs.types import ArrayF64

CUES = R_CUES + B_CUES
"""Keys of a reply, in the order of `tables.CUE_COLUMNS`."""


def prompt_text(*, masked: bool) -> str:
    """The question that goes with an image; ``masked``: parts of it are painted grey and do not count."""
    text = Path(__file__).with_name("prompt.txt").read_text(encoding="utf-8").rstrip("\n")
    mask = "Flat mid-grey areas are masked out: ignore them and their borders.\n" if masked else ""
    return text.replace("{mask}", mask)


def reply_schema() -> dict[str, Any]:
    """JSON schema of a reply.

    Scores are an enumeration: every decoder for constrained output knows it (bounds of numbers, many do not),
    and a model without sense cannot write digits without end. Models tell no finer scores apart.
    """
    score = {"type": "number", "enum": [round(k / 20, 2) for k in range(21)]}
    return {
        "type": "object",
        "properties": dict.fromkeys(CUES, score),
        "required": list(CUES),
        "additionalProperties": False,
    }


class ReplyError(Exception):
    """What is wrong with a reply, in words that the model can be told. Holds no text of the reply."""


def parse_reply(text: str) -> ArrayF64:  # [11] in [0, 1], as tables.CUE_COLUMNS
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
