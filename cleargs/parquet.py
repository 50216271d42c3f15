"""Parquet tables whose schema documents the meaning and unit of each column in the field metadata."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import pyarrow as pa
import pyarrow.parquet as pq

from cleargs.errors import StoreError
from cleargs.files import atomic_path


def column(name: str, kind: pa.DataType, meaning: str, *, nullable: bool = False) -> pa.Field:
    """Return a field whose ``meaning``, with its unit and range, is stored in the file."""
    return pa.field(name, kind, nullable=nullable, metadata={"meaning": meaning})


def schema_of(row: type) -> pa.Schema:
    """Return the schema of the table whose rows are instances of the dataclass ``row``.

    A field ``Annotated[TYPE, MEANING]`` is a column, nullable where None is allowed. A field without a
    meaning is not a column. An Arrow type before the meaning replaces the usual int32, float64, bool or text.
    """
    usual: dict[Any, Any] = {int: pa.int32(), float: pa.float64(), bool: pa.bool_(), str: pa.string()}
    fields = []
    for name, hint in get_type_hints(row, include_extras=True).items():
        if get_origin(hint) is Annotated:
            annotation, *kind, meaning = get_args(hint)
            members = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
            plain = str if get_origin(members[0]) is Literal else members[0]
            found = kind[0] if kind else usual[plain]
            fields.append(column(name, found, meaning, nullable=NoneType in members))
    return pa.schema(fields)


def write_table(path: Path, table: pa.Table, schema: pa.Schema) -> None:
    """Write ``table`` with exactly ``schema`` to ``path``, atomically. Equal rows give equal bytes.

    Raises ValueError if a column is missing or does not fit its type (also pyarrow's ArrowInvalid).
    """
    table = table.select(schema.names).cast(schema)
    with atomic_path(path) as temporary:
        pq.write_table(table, temporary, compression="zstd", store_schema=True)


def read_table(path: Path, schema: pa.Schema) -> pa.Table:
    """Read a table that `write_table` wrote, with the columns of ``schema`` in its order.

    A nullable column that the file of an older version lacks is filled with nulls. StoreError is raised if
    the file is missing or damaged, or if it lacks another column.
    """
    with read_errors(path):
        table = pq.read_table(path)
        for field in schema:
            if field.nullable and field.name not in table.column_names:
                table = table.append_column(field, pa.nulls(table.num_rows, field.type))
        return table.select(schema.names).cast(schema)


def meanings(schema: pa.Schema) -> dict[str, str]:
    """Return column -> meaning, as stored in the file."""
    return {field.name: (field.metadata or {}).get(b"meaning", b"").decode() for field in schema}


def table_meanings(folder: Path, names: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return name -> `meanings` of the tables among the files ``names`` in ``folder``."""
    tables = sorted(name for name in names if name.endswith(".parquet"))
    return {name: meanings(pq.read_schema(folder / name)) for name in tables}


def read_any_table(path: Path) -> pa.Table:
    """Read a table with all its columns. Raises StoreError if it is missing or damaged."""
    with read_errors(path):
        return pq.read_table(path)


@contextmanager
def read_errors(path: Path) -> Iterator[None]:
    """Turn an error while the table at ``path`` is read into a StoreError that names it."""
    try:
        yield
    except (OSError, pa.ArrowException, ValueError, KeyError) as error:
        raise StoreError(
            f"cannot read the table {path.name}: {str(error).splitlines()[0]}",
            hint="delete the stage's folder, or run its stage again with --force",
        ) from error
