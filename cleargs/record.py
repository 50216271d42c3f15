"""What settings, manifests and reports are made of: models whose values are checked and never change."""

from pydantic import BaseModel, ConfigDict


class Record(BaseModel):
    """A frozen model that forbids unknown fields, so that a misspelt name is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")
