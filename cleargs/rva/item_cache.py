"""What was found out about single frames, kept so that adding frames to a capture costs only those."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cleargs.files import write_json
from cleargs.rva.evaluator import View
from cleargs.rva.scores import Floats
from cleargs.untrusted import read_json


class ItemCache:
    """Rows of numbers with named columns, a JSON file each, named by the digest of all that decides them."""

    def __init__(self, folder: Path, columns: Sequence[str]) -> None:
        self._folder = folder
        self._columns = columns

    def find(self, digest: str) -> Floats | None:
        """The row; None where there is none, or where its file is damaged."""
        try:
            kept = read_json(self._folder / f"{digest}.json")
            row = np.array([kept[column] for column in self._columns], dtype=np.float64)
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return row if bool(np.isfinite(row).all()) else None

    def add(self, digest: str, row: Floats) -> None:
        """Keep ``row``; the file appears whole."""
        self._folder.mkdir(parents=True, exist_ok=True)
        write_json(self._folder / f"{digest}.json", dict(zip(self._columns, row.tolist(), strict=True)))


def view_digest(facts: Sequence[object], view: View) -> str:
    """Names what is found out about the files of ``view`` in the light of ``facts`` (JSON values).

    Raises OSError when a file cannot be read.
    """
    parts = [hashlib.sha256(path.read_bytes()).hexdigest() for path in (view.image, view.mask) if path]
    return hashlib.sha256(json.dumps([*facts, *parts]).encode()).hexdigest()
