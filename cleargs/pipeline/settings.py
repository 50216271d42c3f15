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

SYNONYMS: Mapping[str, tuple[str, ...]] = {
    "steps": ("iterations", "iters", "epochs", "max_steps"),
    "max_size": ("resolution", "size", "width", "long_side"),
    "max_frames": ("frames", "images", "num_frames"),
    "fps": ("frame_rate",),
    "holdout": ("split", "test", "validation", "llffhold"),
    "camera_model": ("camera",),
    "max_features": ("features",),
    "budget": ("gaussians", "splats", "max_gaussians", "cap_max"),
    "sh_degree": ("degree", "sh"),
    "ssim_lambda": ("dssim", "lambda_dssim"),
    "lr_means": ("learning_rate", "lr", "position_lr_init"),
    "lr_opacities": ("opacity_lr",),
    "lr_scales": ("scaling_lr",),
    "lr_rotations": ("rotation_lr",),
    "lr_sh": ("feature_lr",),
    "refine_every": ("densification_interval",),
    "refine_start": ("densify_from_iter",),
    "refine_stop": ("densify_until_iter",),
    "background": ("bg", "white_background"),
    "antialias": ("mip",),
    "tau_R": ("threshold",),
    "evaluator": ("judge",),
    "expert": ("restorer", "model"),
    "primary_scorer": ("metric", "scorer"),
    "use_fused": ("fused",),
    "undo_motion": ("deblur",),
    "seed": ("random_seed",),
}
"""The last part of a name here -> what people and other programs call it."""

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
    meant = next((here for here, words in SYNONYMS.items() if name.lower() in words), name)
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
