"""The settings of all stages, with default, range and meaning."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import AliasChoices, BaseModel
from pydantic.fields import FieldInfo

TYPE_NAMES: Mapping[Any, str] = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
"""Type -> its name for users."""

LIMITS = (("ge", "at least"), ("gt", "more than"), ("le", "at most"), ("lt", "less than"))
"""Pydantic's name for an end of a range -> the words of a message."""

OPTIONS = ("threads", "device", "store", "until")
"""Names that users try as settings, although they are options of the command line."""


@dataclass(frozen=True)
class Setting:
    """One setting of a stage."""

    name: str
    """Full name, with stage and tables, for example ``rivr.distil.steps``."""
    default: Any
    """A JSON value; None if unset."""
    allowed: str
    """Type and range, for users."""
    meaning: str

    @property
    def default_text(self) -> str:
        """The default as written after ``--set NAME=``; "unset" for None."""
        if self.default is None:
            return "unset"
        return self.default or '""' if isinstance(self.default, str) else json.dumps(self.default)


def settings_of(section: str, model: type[BaseModel]) -> list[Setting]:
    """Return the settings of the stage ``section``, in the order in which its model declares them."""
    defaults = model()
    plain = dict(flattened(defaults.model_dump(mode="json")))
    return [
        Setting(
            f"{section}.{name}",
            plain[name],
            allowed(field.annotation, field.metadata),
            field.description or "",
        )
        for name, field, _ in fields_of(defaults)
    ]


def fields_of(model: BaseModel, prefix: str = "") -> Iterator[tuple[str, FieldInfo, Any]]:
    """Yield dotted name, declaration and value of each setting in a table and its subtables."""
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from fields_of(value, f"{prefix}{name}.")
        else:
            yield prefix + name, field, value


def former_names(field: FieldInfo) -> list[str]:
    """Return the names that a setting had in older versions, which are still read."""
    alias = field.validation_alias
    return [str(name) for name in alias.choices[1:]] if isinstance(alias, AliasChoices) else []


def flattened(tables: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted name and value of each setting in nested tables."""
    for name, value in tables.items():
        if isinstance(value, dict):
            yield from flattened(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def allowed(annotation: Any, metadata: Iterable[Any] = ()) -> str:
    """Return the values that a field allows, for users: its choices, or its type and range."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return allowed(parts[0], [limit for field in parts[1:] for limit in field.metadata])
    if origin is Literal:
        words = " or ".join(map(str, parts))
    elif origin is tuple:
        count = "any number of" if parts[-1] is Ellipsis else len(parts)
        words = f"{count} values, each {allowed(parts[0])}"
    elif origin in (Union, UnionType):
        words = " or ".join(allowed(kind) for kind in parts if kind is not NoneType)
    else:
        words = TYPE_NAMES[annotation]
    limits = [
        f"{word} {getattr(item, attribute)}"
        for attribute, word in LIMITS
        for item in metadata
        if getattr(item, attribute, None) is not None
    ]
    return f"{words}, {' and '.join(limits)}" if limits else words


def suggestion(name: str, known: Collection[str]) -> str:
    """Return a hint with the setting that the user probably meant by the unknown ``name``.

    The table of ``name`` is searched first for a similar name, then its stage, then all ``known`` names.
    """
    table, _, field = name.rpartition(".")
    if field in OPTIONS:
        return f"use the option --{field}"
    for place in (table, name.partition(".")[0], ""):
        inside = {
            full.rpartition(".")[2]: full for full in known if not place or full.startswith(f"{place}.")
        }
        if near := get_close_matches(field, inside, n=1, cutoff=0.7):
            return f"did you mean {inside[near[0]]}?"
    siblings = [full for full in known if full.rpartition(".")[0] == table]
    return f"choose one of {', '.join(siblings)}, or see cleargs settings"
