"""The question to the model, and the parser of its reply.

The parser is strict: it does not clip, complete or guess values. Each change of ``prompt.txt`` must raise
`QwenConfig.prompt`, which is part of the stage's key and of the table.
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
    """Return the question about an image. If ``masked``, it says to ignore the grey parts."""
    text = Path(__file__).with_name("prompt.txt").read_text(encoding="utf-8").rstrip("\n")
    mask = "Flat mid-grey areas are masked out: ignore them and their borders.\n" if masked else ""
    return text.replace("{mask}", mask)


def reply_schema() -> dict[str, Any]:
    """Return the JSON schema of a reply.

    Scores are an enumeration in steps of 0.05, since models do not distinguish finer steps. All constrained
    decoders support enumerations, but many do not support bounds of numbers.
    """
    score = {"type": "number", "enum": [round(k / 20, 2) for k in range(21)]}
    return {
        "type": "object",
        "properties": dict.fromkeys(CUES, score),
        "required": list(CUES),
        "additionalProperties": False,
    }


class ReplyError(Exception):
    """An invalid reply. The message is sent to the model and contains no text of the reply."""


def parse_reply(text: str) -> ArrayF64:  # [11] in [0, 1], as tables.CUE_COLUMNS
    """Return the cues in the JSON object of ``text``. Other text around the object is ignored.

    Raises ReplyError if there is no object, if several objects differ, or if it does not match the schema (a
    missing, unknown or non-numeric value, or one outside [0, 1]).
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
    """Yield the outermost JSON objects in ``text``, from left to right."""
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
            raise ReplyError(f"{name} is not a number")
        if not 0.0 <= score <= 1.0:  # NaN included
            raise ReplyError(f"{name} lies outside [0, 1]")
    return tuple(float(value[name]) for name in CUES)
