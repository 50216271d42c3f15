"""The configuration of a run: defaults, then a recipe, then single settings, checked by each stage's model.

A document has one table per stage, and ``seed``. The CONFIG model of a stage declares its settings.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import accumulate
from pathlib import Path
from typing import Any, cast

from pydantic import BaseModel, ValidationError

from cleargs.errors import ConfigError, did_you_mean
from cleargs.pipeline.settings import Setting, fields_of, flattened, former_names, settings_of, suggestion
from cleargs.pipeline.stages import Stages
from cleargs.safe_io import FAULTS, faults_as, read_text

RECIPES = "cleargs.workflows"
"""The package with the recipes that have a name."""

MAX_SEED = 2**63 - 1
"""The largest signed integer of 64 bits, which is the largest integer in TOML."""

Document = dict[str, Any]


@dataclass(frozen=True)
class Config:
    """A checked configuration."""

    seed: int
    sections: Mapping[str, BaseModel]
    """Stage -> its settings, with the defaults filled in."""
    effective: Mapping[str, BaseModel]
    """Stage -> its settings, under the recipe of the quality. Runs use these, and keys hold them."""

    def document(self) -> Document:
        """Return the full configuration for TOML, which has no null: settings that are None are left out."""
        tables = {
            name: model.model_dump(mode="json", exclude_none=True) for name, model in self.sections.items()
        }
        return {"seed": self.seed, **tables}

    def settings(self) -> Iterator[tuple[Setting, Any]]:
        """Yield each setting of the stages, and its value as a JSON value."""
        for section, model in self.sections.items():
            values = dict(flattened({section: model.model_dump(mode="json")}))
            yield from ((setting, values[setting.name]) for setting in settings_of(section, type(model)))


def load_config(
    dag: Stages, recipe: str | Document = "default", overrides: Sequence[str] = (), seed: int | None = None
) -> Config:
    """Return the checked configuration of a recipe: a name, the path of a TOML file, or a document.

    ``overrides`` are settings as ``a.b=value``, which replace those of the recipe; the last one wins. Raises
    ConfigError if the recipe cannot be read, or a setting is unknown or out of range.
    """
    document = read_recipe(recipe) if isinstance(recipe, str) else recipe
    for text in overrides:
        document = merge(document, parse_override(text))
    if seed is not None:
        document = merge(document, {"seed": seed})
    return check_document(dag, document)


def read_recipe(recipe: str) -> Document:
    """Return the document of the named recipe, or of the TOML file at the path ``recipe``."""
    if recipe.endswith(".toml") or "/" in recipe:
        return read_toml(Path(recipe))
    names = recipe_names()
    if recipe not in names:
        raise ConfigError(
            f"there is no recipe {recipe!r}",
            hint=did_you_mean(recipe, names, f"choose one of {', '.join(names)}, or give a .toml file"),
        )
    return parse_toml(files(RECIPES).joinpath(f"{recipe}.toml").read_text(encoding="utf-8"), f"{recipe}.toml")


def recipe_names() -> list[str]:
    """Return the names of the recipes that have one."""
    names = (entry.name for entry in files(RECIPES).iterdir())
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def read_toml(path: Path) -> Document:
    """Read a TOML file. Raises ConfigError if it cannot be read."""
    with faults_as(ConfigError, f"cannot read {path}", hint="check the path of the TOML file"):
        text = read_text(path)
    return parse_toml(text, path.name)


def parse_toml(text: str, name: str) -> Document:
    """Parse TOML. ``name`` is the file name for the message of a ConfigError."""
    with faults_as(ConfigError, f"{name} is not valid TOML", hint="see https://toml.io for the syntax"):
        return tomllib.loads(text)  # TOMLDecodeError is a ValueError


def parse_override(text: str) -> Document:
    """Return the document of ``a.b=value``. A value that is not valid TOML is used as a string."""
    name, equals, value = text.partition("=")
    parts = [part.strip() for part in name.split(".")]
    if not equals or not all(parts):
        raise ConfigError(
            f"--set {text!r} does not have the form a.b=value", hint="example: --set rva.tau_R=0.7"
        )
    document = {parts.pop(): _toml_value(value.strip())}
    for part in reversed(parts):
        document = {part: document}
    return document


def _toml_value(text: str) -> Any:
    try:
        document = tomllib.loads(f"value = {text}")
    except FAULTS:
        return text
    return document["value"] if len(document) == 1 else text


def merge(base: Mapping[str, Any], top: Mapping[str, Any]) -> Document:
    """Return ``base`` with the values of ``top`` in place of its own. Merges tables, replaces lists."""
    merged = dict(base)
    for name, value in top.items():
        below = merged.get(name)
        merged[name] = merge(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def check_document(dag: Stages, document: Mapping[str, Any]) -> Config:
    """Check a document with the stages' models and fill in the defaults. Raises ConfigError."""
    seed = document.get("seed", 0)
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
        raise ConfigError(
            f"seed = {seed!r} cannot be used", hint=f"allowed: a whole number from 0 to {MAX_SEED}"
        )
    models = {name: dag.load(name).CONFIG for name in dag.names}
    for name in document:
        if name != "seed" and name not in models:
            raise _unknown_setting(name, models)
    sections = _checked(models, document)
    used = sections
    for name in (recipe for model in sections.values() for recipe in laid_over(model)):
        used = _checked(models, merge(document, _limited(read_recipe(name), sections)))
    return Config(seed, sections, used)


def laid_over(model: BaseModel) -> Iterator[str]:
    """Yield the names of recipes that a value of a setting selects.

    Such a setting is declared with ``json_schema_extra={"recipes": [VALUE]}``. The recipe ``VALUE`` is then
    laid over the settings.
    """
    for _, field, value in fields_of(model):
        extra = field.json_schema_extra
        if isinstance(extra, dict) and value in cast(list[str], extra.get("recipes", [])):
            yield value


def _limited(recipe: Document, own: Mapping[str, BaseModel]) -> Document:
    """Return ``recipe`` with the limits (settings ``max_...``) of ``own`` where these are lower."""
    return {
        stage: {
            name: min(value, getattr(own[stage], name)) if name.startswith("max_") else value
            for name, value in table.items()
        }
        for stage, table in recipe.items()
        if stage in own
    }


def _checked(models: Mapping[str, type[BaseModel]], document: Mapping[str, Any]) -> dict[str, BaseModel]:
    sections: dict[str, BaseModel] = {}
    for name, model in models.items():
        try:
            sections[name] = model.model_validate(document.get(name, {}))
        except ValidationError as error:
            raise _setting_error(name, models, error) from error
    return sections


def known_settings(dag: Stages, document: Mapping[str, Any]) -> tuple[Document, list[str]]:
    """Return the settings of ``document`` that this version has, and the names of the others.

    The file of a run that another version wrote may have others.
    """
    tables = {name: dag.load(name).CONFIG for name in dag.names}
    known: Document = {"seed": document["seed"]} if "seed" in document else {}
    others = [name for name in document if name not in (*tables, "seed")]
    for name, model in tables.items():
        if name in document:
            known[name] = _known(document[name], model, name, others)
    return known, others


def _known(table: Any, model: Any, place: str, others: list[str]) -> Any:
    """Return ``table`` without the settings that ``model`` does not have, which are added to ``others``."""
    if not (isinstance(table, dict) and isinstance(model, type) and issubclass(model, BaseModel)):
        return table
    names = {old: name for name, field in model.model_fields.items() for old in (name, *former_names(field))}
    others += [f"{place}.{name}" for name in table if name not in names]
    return {
        names[name]: _known(value, model.model_fields[names[name]].annotation, f"{place}.{name}", others)
        for name, value in table.items()
        if name in names
    }


def _setting_error(
    section: str, models: Mapping[str, type[BaseModel]], error: ValidationError
) -> ConfigError:
    first = error.errors(include_url=False)[0]
    name = ".".join([section, *map(str, first["loc"])])
    if first["type"] == "extra_forbidden":
        return _unknown_setting(name, models)
    known = {setting.name: setting for setting in settings_of(section, models[section])}
    if first["type"] == "model_type":
        inner = next(full for full in known if full.startswith(f"{name}."))
        return ConfigError(
            f"{name} = {first['input']!r} cannot be used: {name} is a table of settings",
            hint=f"set one of them, for example {inner}",
        )
    message = first["msg"].removeprefix("Value error, ")
    # Pydantic's location may go further than the setting: to the item of a list or the member of a union.
    setting = next((known[place] for place in _prefixes(name) if place in known), None)
    if setting is None:
        return ConfigError(f"{name}: {message}", hint=f"change the settings of [{name}]")
    # The message of a ClearGS validator says more than the type.
    own = first["type"] == "value_error"
    hint = message[:1].lower() + message[1:] if own else f"allowed: {setting.allowed}"
    return ConfigError(f"{setting.name} = {first['input']!r} cannot be used", hint=hint)


def _unknown_setting(name: str, models: Mapping[str, type[BaseModel]]) -> ConfigError:
    """Return the error for an unknown setting, with a hint at the setting that the user probably meant."""
    settings = (setting.name for section, model in models.items() for setting in settings_of(section, model))
    known = dict.fromkeys(place for full in ("seed", *settings) for place in _prefixes(full))
    return ConfigError(f"there is no setting {name}", hint=suggestion(name, known))


def _prefixes(name: str) -> Iterator[str]:
    """Yield the stage of a dotted name, then its tables, then the full name."""
    return accumulate(name.split("."), "{}.{}".format)
