"""Base classes of settings, manifests and reports: immutable models with checked values."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, model_validator
from pydantic_core import PydanticCustomError

Unit = Annotated[float, Field(ge=0.0, le=1.0)]
"""A number in [0, 1]."""


class FrozenModel(BaseModel):
    """An immutable model without unknown fields, so that a misspelt name is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Inherited(NamedTuple):
    """Mark a retired setting that follows the setting of the same name in another section."""

    section: str
    strictly: bool = True
    """False if the retired setting had no effect: any value is dropped."""


class Settings(FrozenModel):
    """A table of settings, which also reads the ``run.toml`` of earlier versions.

    Retired settings are the constants of the class and the names in ``RETIRED``. One is dropped if it has the
    value that now applies. Otherwise the error says what to set instead.
    """

    RETIRED: ClassVar[Mapping[str, Any]] = {}
    """Name -> the value that now applies, or `Inherited`."""

    @model_validator(mode="before")
    @classmethod
    def _without_retired(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, Mapping):
            return data
        return {name: value for name, value in data.items() if not cls._dropped(name, value, info.context)}

    @classmethod
    def _dropped(cls, name: str, value: Any, sections: Any) -> bool:
        constants = {known: getattr(cls, known) for known in cls.__class_vars__ if known != "RETIRED"}
        retired = {**constants, **cls.RETIRED}
        if name in cls.model_fields or name not in retired:
            return False
        now, instead = retired[name], "take the line out, its value cannot be changed"
        if isinstance(now, Inherited):
            if now.strictly and not sections:
                return False
            instead = f"set {now.section}.{name}, which holds for all stages, and take the line out"
            now = getattr(sections[now.section], name) if now.strictly else value
        if not _alike(now, value):
            raise PydanticCustomError("retired", "retired", {"name": name, "value": value, "hint": instead})
        return True


def _alike(now: Any, value: Any) -> bool:
    """Return True if ``value``, from a TOML or JSON document, equals the present value ``now``."""
    if isinstance(value, Mapping):
        return all(_alike(getattr(now, name, inner), inner) for name, inner in value.items())
    return bool((list(now) if isinstance(now, tuple) else now) == value)
