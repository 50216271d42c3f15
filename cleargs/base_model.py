"""Base classes of settings, manifests and reports: immutable models with checked values."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Unit = Annotated[float, Field(ge=0.0, le=1.0)]
"""A number in [0, 1]."""


class FrozenModel(BaseModel):
    """An immutable model without unknown fields, so that a misspelt name is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")
