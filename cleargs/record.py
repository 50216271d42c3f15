"""What settings, manifests and reports are made of: models whose values are checked and never change."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Unit = Annotated[float, Field(ge=0.0, le=1.0)]
"""A number in [0, 1]."""


class Record(BaseModel):
    """A frozen model that forbids unknown fields, so that a misspelt name is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")
