"""Any Parquet table in a few figures a column."""

from __future__ import annotations

from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

MAX_COUNTED_VALUES = 12
"""A column of words with more different values than this is not counted value by value."""


def describe_table(table: pa.Table) -> dict[str, dict[str, Any]]:
    """Column -> its meaning (from the field's metadata), nulls, and figures that suit its type.

    Words and booleans: ``counts`` of each value, most frequent first (``distinct`` where there are many, or
    where every row has its own).
    Numbers: ``min``, ``median``, ``mean``, ``max`` over the values that are neither null nor NaN.
    """
    return {field.name: _describe(field, table[field.name]) for field in table.schema}


def _describe(field: pa.Field, column: pa.ChunkedArray) -> dict[str, Any]:
    facts: dict[str, Any] = {"type": str(field.type), "nulls": column.null_count}
    if field.metadata and b"meaning" in field.metadata:
        facts["meaning"] = field.metadata[b"meaning"].decode()
    if pa.types.is_integer(field.type) or pa.types.is_floating(field.type):
        return {**facts, **_figures(column)}
    if pa.types.is_string(field.type) or pa.types.is_boolean(field.type):
        counts = {item["values"]: item["counts"] for item in pc.value_counts(column).to_pylist()}
        counts.pop(None, None)
        names = len(counts) > 2 and len(counts) == len(column) - column.null_count
        if len(counts) <= MAX_COUNTED_VALUES and not names:
            ordered = sorted(counts.items(), key=lambda item: (-item[1], str(item[0])))
            return {**facts, "counts": {_word(value): count for value, count in ordered}}
        return {**facts, "distinct": len(counts)}
    return {**facts, "distinct": len({str(value) for value in column.to_pylist()})}


def _figures(column: pa.ChunkedArray) -> dict[str, Any]:
    values = column.drop_null()
    if pa.types.is_floating(column.type):
        values = values.filter(pc.is_finite(values))
    if len(values) == 0:
        return {"distinct": 0}
    return {
        "min": pc.min(values).as_py(),
        "median": pc.quantile(values, q=0.5)[0].as_py(),
        "mean": pc.mean(values).as_py(),
        "max": pc.max(values).as_py(),
    }


def _word(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def sampled_rows(table: pa.Table, wanted: int) -> list[dict[str, Any]]:
    """``wanted`` rows (at most), evenly spread, the first and the last among them."""
    last = table.num_rows - 1
    if last < wanted:
        chosen = list(range(last + 1))
    elif wanted == 1:
        chosen = [last]
    else:
        chosen = [round(index * last / (wanted - 1)) for index in range(wanted)]
    rows: list[dict[str, Any]] = table.take(chosen).to_pylist()
    return rows
