"""The figures of a manifest in words for people; ``--json`` has them under the names of the manifest."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

MAX_LISTED = 16
"""Most items of a list that are spelt out."""

HEADLINES = frozenset(
    {"frames", "registered", "test", "points", "roles", "gaussians", "psnr_unseen", "repairs", "published"}
)
"""What is worth a place in the overview of a run."""

HIDDEN = frozenset({"similarity", "holdout_hash", "round"})
"""Figures for programs."""

WORDS: Mapping[str, str] = {
    "kind": "input",
    "poses": "poses from",
    "given_poses_missed_px": "features miss their points at the given poses by, px (median)",
    "frames": "frames",
    "frames_available": "frames in the input",
    "registered": "frames with a pose",
    "placed": "poses",
    "test": "frames held out for testing",
    "points": "sparse points",
    "observations": "observations of points",
    "mean_reprojection_error_px": "reprojection error, px (mean)",
    "evaluator": "judged by",
    "roles": "roles",
    "reactivated_for": "reactivated for",
    "active": "frames in use",
    "reliable": "reliable frames",
    "stand_in": "frames that stand in for reliable ones",
    "weights": "frames by weight",
    "effective_frames": "equivalent frames of full weight",
    "bins": "stretches of the trajectory",
    "bins_uncovered_before": "stretches without a usable frame at first",
    "views": "frames trained on",
    "gaussians_start": "Gaussians at the start",
    "gaussians": "Gaussians",
    "steps": "steps",
    "sh_degree": "SH degree",
    "exposure": "exposure compensation",
    "exposure_spread": "spread of the frames' brightness",
    "psnr_strong": "training PSNR of the strong frames, dB",
    "psnr_active": "training PSNR, dB",
    "psnr_unseen": "PSNR of pixels that no training saw, dB",
    "expert": "restorer",
    "repairs": "repairs",
    "scorer": "scorer",
    "chosen": "chosen",
    "latest_rounds": "repairs by round",
    "published": "published",
    "rounds.chosen": "chosen",
    "rounds.accepted": "accepted",
    "rounds.refused": "refused",
    "rounds.repairs_refused": "repairs refused by the gate",
    "rounds.tie_breaks": "decided by the tie-break scorer",
    "rounds.scorers": "scorers",
    "rounds.mean_scores": "mean scores",
    "held_back.frames": "frames held back from repair",
    "held_back.psnr_before": "their PSNR in the first scene, dB",
    "held_back.psnr_after": "their PSNR now, dB",
    "held_back.score_before": "their score in the first scene",
    "held_back.score_after": "their score now",
    "held_back.harm": "harm done to them",
}
"""Figure of a manifest (rounds without their numbers) -> what to call it, in the order of reading."""

AS_FILMED = "as filmed"
"""What is called "observed" in tables: the raw frame, which needs no repair."""

_ORDER = {name: place for place, name in enumerate(WORDS)}


def in_words(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What to call each figure of ``summary``, and its value as text."""

    def place(fact: tuple[tuple[str, ...], Any]) -> tuple[int, int]:
        return _number(fact[0]) or 0, _ORDER.get(_key(fact[0]), len(_ORDER))

    lines = (_line(path, value) for path, value in sorted(_facts(summary, ()), key=place))
    return [(label, text) for label, text in lines if text]


def headlines(summary: Mapping[str, Any]) -> str:
    """The figures of ``summary`` for one line: those of `HEADLINES`, and those that have no words yet."""
    chosen = {name: value for name, value in summary.items() if name in HEADLINES or name not in WORDS}
    plain = {
        name: value
        for name, value in chosen.items()
        if name in HEADLINES or not isinstance(value, (dict, list))
    }
    return ", ".join(f"{label} {text}" for label, text in in_words(plain))


def _facts(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path and value of each line: tables of plain values stay together, unless their names have words."""
    if isinstance(value, Mapping):
        plain = not any(isinstance(item, (Mapping, list)) for item in value.values())
        if path and plain and not any(".".join((*_named(path), name)) in WORDS for name in value):
            yield path, value
            return
        for name, item in value.items():
            if name not in HIDDEN:
                yield from _facts(item, (*path, name))
    elif isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        for number, item in enumerate(value, 1):
            yield from _facts(item, (*path, str(number)))
    else:
        yield path, value


def _named(path: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for name in path if not name.isdecimal())


def _key(path: tuple[str, ...]) -> str:
    return ".".join(_named(path))


def _number(path: tuple[str, ...]) -> int | None:
    """Which round the figure is of."""
    return next((int(name) for name in path if name.isdecimal()), None)


def _line(path: tuple[str, ...], value: Any) -> tuple[str, str]:
    key, number = _key(path), _number(path)
    label = WORDS.get(key) or ", ".join(name.replace("_", " ") for name in _named(path))
    match key:
        case "weights":
            return label, ", ".join(f"{count} from {low}" for low, count in value.items() if count)
        case "latest_rounds":
            return label, ", ".join(f"{count} in round {last}" for last, count in value.items())
        case "held_back.harm":
            return label, value or "none"
    return f"round {number}: {label}" if number else label, text_of(value)


def text_of(value: Any) -> str:
    """A value for a reader: four figures of a number, yes and no, "9 restored, 3 render" for counts."""
    match value:
        case None:
            return ""
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.4g}"
        case list():
            return ", ".join(text_of(item) for item in value[:MAX_LISTED]) + (
                " ..." if len(value) > MAX_LISTED else ""
            )
        case Mapping():
            counts = all(isinstance(item, int) for item in value.values())
            names = {name: name.replace("_", " ").replace("observed", AS_FILMED) for name in value}
            if counts:
                return ", ".join(f"{count} {names[name]}" for name, count in value.items() if count) or "none"
            return ", ".join(f"{names[name]} {text_of(item)}" for name, item in value.items())
    return str(value)
