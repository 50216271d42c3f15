"""Tables are declared by the dataclasses of their rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import pyarrow as pa

from cleargs.parquet import column, schema_of


@dataclass(frozen=True)
class Row:
    number: Annotated[int, "counts"]
    share: Annotated[float | None, pa.float32(), "of the whole, in [0, 1]"]
    length: Annotated[float, "px"]
    kind: Annotated[Literal["a", "b"], "a or b"]
    here: Annotated[bool, "true or false"]
    path: str


def test_schema_of_a_dataclass() -> None:
    expected = pa.schema(
        [
            column("number", pa.int32(), "counts"),
            column("share", pa.float32(), "of the whole, in [0, 1]", nullable=True),
            column("length", pa.float64(), "px"),
            column("kind", pa.string(), "a or b"),
            column("here", pa.bool_(), "true or false"),
        ]
    )
    assert schema_of(Row).equals(expected, check_metadata=True)
