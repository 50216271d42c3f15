"""What a run may be told: every setting of the stages' models with its default, range and meaning."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

KIND_WORDS: Mapping[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
}
"""How the types of settings are called."""

SYNONYMS: Mapping[str, str] = {
    "iterations": "steps",
    "iters": "steps",
    "epochs": "steps",
    "max_steps": "steps",
    "resolution": "max_size",
    "size": "max_size",
    "width": "max_size",
    "long_side": "max_size",
    "frames": "max_frames",
    "images": "max_frames",
    "num_frames": "max_frames",
    "frame_rate": "fps",
    "split": "holdout",
    "test": "holdout",
    "validation": "holdout",
    "llffhold": "holdout",
    "camera": "camera_model",
    "features": "max_features",
    "gaussians": "budget",
    "splats": "budget",
    "max_gaussians": "budget",
    "cap_max": "budget",
    "degree": "sh_degree",
    "sh": "sh_degree",
    "dssim": "ssim_lambda",
    "lambda_dssim": "ssim_lambda",
    "learning_rate": "lr_means",
    "lr": "lr_means",
    "position_lr_init": "lr_means",
    "opacity_lr": "lr_opacities",
    "scaling_lr": "lr_scales",
    "rotation_lr": "lr_rotations",
    "feature_lr": "lr_sh",
    "densification_interval": "refine_every",
    "densify_from_iter": "refine_start",
    "densify_until_iter": "refine_stop",
    "bg": "background",
    "white_background": "background",
    "mip": "antialias",
    "threshold": "tau_R",
    "judge": "evaluator",
    "restorer": "expert",
    "model": "expert",
    "metric": "primary_scorer",
    "scorer": "primary_scorer",
    "fused": "use_fused",
    "deblur": "undo_motion",
    "random_seed": "seed",
}
"""What people and other programs call a setting -> the last part of its name here."""

OPTIONS = ("threads", "device", "store", "until")
"""What is no setting, but an option of the command line."""


@dataclass(frozen=True)
class Setting:
    """One setting of a stage."""

    name: str
    """With its stage and tables: ``rivr.distil.steps``."""
    default: Any
    """A JSON value; None: unset."""
    allowed: str
    """Type and range in words; "" where they say nothing."""
    meaning: str

    @property
    def table(self) -> str:
        """The name without its last part."""
        return self.name.rpartition(".")[0]

    @property
    def field(self) -> str:
        """The last part of the name."""
        return self.name.rpartition(".")[2]

    @property
    def default_text(self) -> str:
        """The default as it is written after ``--set NAME=``; "unset" for None."""
        match self.default:
            case None:
                return "unset"
            case bool():
                return str(self.default).lower()
            case str():
                return self.default or '""'
            case list():
                return f"[{', '.join(map(str, self.default))}]"
        return str(self.default)


def settings_of(section: str, model: type[BaseModel]) -> list[Setting]:
    """The settings of a stage in the order in which its model declares them."""
    return list(_walk(section, model()))


def _walk(prefix: str, defaults: BaseModel) -> Iterator[Setting]:
    plain = defaults.model_dump(mode="json")
    for name, field in type(defaults).model_fields.items():
        value, full = getattr(defaults, name), f"{prefix}.{name}"
        if isinstance(value, BaseModel):
            yield from _walk(full, value)
        else:
            yield Setting(full, plain[name], allowed(field), field.description or "")


def names_of(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """The dotted names of all settings of ``model``."""
    for name, field in model.model_fields.items():
        inner = inner_model(field)
        if inner is None:
            yield prefix + name
        else:
            yield from names_of(inner, f"{prefix}{name}.")


def inner_model(field: FieldInfo) -> type[BaseModel] | None:
    """The model of a field that is a table of settings; None for a single setting."""
    for kind in (field.annotation, *get_args(field.annotation)):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind
    return None


def allowed(field: FieldInfo) -> str:
    """What a field takes, in words: its choices, or its type and range. "" where words fail."""
    return _allowed(field.annotation, field.metadata)


def _allowed(annotation: Any, metadata: list[Any]) -> str:
    kinds: list[Any] = [annotation]
    if get_origin(annotation) in (Union, UnionType):
        kinds = [kind for kind in get_args(annotation) if kind is not type(None)]
    words = []
    for kind in kinds:
        if get_origin(kind) is Literal:
            words += [str(choice) for choice in get_args(kind)]
        elif get_origin(kind) is tuple:
            words.append(_several(get_args(kind)))
        elif get_origin(kind) is Annotated:
            words.append(_annotated(kind))
        else:
            words.append(KIND_WORDS.get(kind, ""))
    if not all(words):
        return ""
    limits = []
    for attribute, word in (("ge", "at least"), ("gt", "more than"), ("le", "at most"), ("lt", "less than")):
        for item in metadata:
            limit = getattr(item, attribute, None)
            limits += [] if limit is None else [f"{word} {limit}"]
    text = " or ".join(words)
    return f"{text}, {' and '.join(limits)}" if limits else text


def _several(kinds: tuple[Any, ...]) -> str:
    """What a list of a fixed length takes."""
    first = kinds[0]
    each = _annotated(first) if get_origin(first) is Annotated else _allowed(first, [])
    return f"{len(kinds)} values, each {each}" if each else ""


def _annotated(kind: Any) -> str:
    """What a type with limits of its own takes."""
    inner, *fields = get_args(kind)
    return _allowed(inner, [item for field in fields for item in field.metadata])


def suggestion(name: str, prefix: str, siblings: list[str], models: Mapping[str, type[BaseModel]]) -> str:
    """What was probably meant by the unknown setting ``prefix + name``, as a hint; "" for no idea.

    By meaning first, then by spelling; among its siblings first, then anywhere.
    """
    if name in OPTIONS:
        return f"that is an option: --{name}"
    everything = [f"{section}.{full}" for section, model in models.items() for full in names_of(model)]
    by_last = {full.rpartition(".")[2]: full for full in reversed(everything)} | {"seed": "seed"}
    meant = SYNONYMS.get(name.lower(), name)
    if meant in siblings:
        return f"did you mean {prefix}{meant}?"
    if meant in by_last:
        inside = [full for full in everything if full.startswith(prefix) and full.endswith(f".{meant}")]
        return f"did you mean {(inside or [by_last[meant]])[0]}?"
    if near := get_close_matches(name, siblings, n=1):
        return f"did you mean {prefix}{near[0]}?"
    if near := get_close_matches(name, by_last, n=1):
        return f"did you mean {by_last[near[0]]}?"
    return ""
