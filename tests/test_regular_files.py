"""Untrusted documents: a pipe does not block their readers, and deep nesting does not crash them."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from cleargs.capture.tables import load_frames
from cleargs.errors import CleargsError
from cleargs.evaluate.eval_report import read_report
from cleargs.media.image import image_size
from cleargs.models.install import read_checked
from cleargs.models.registry import find_model, read_receipt
from cleargs.report.report_json import is_current
from cleargs.rva.evaluator import ItemCache

DEEP = "[" * 200_000


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "eval.json": ("eval.json", lambda folder: read_report(folder / "eval.json")),
    "note of a report": ("report/report.json", lambda folder: is_current(folder, {})),
    "kept findings": ("a.json", lambda folder: ItemCache(folder, ("a",), ()).find(folder / "a.json")),
    "receipt of a model": ("musiq.receipt.json", lambda folder: read_receipt(find_model("musiq"), folder)),
    "published weights": (
        "weights",
        lambda folder: read_checked(folder / "weights", find_model("lpips").source),
    ),
    "table of frames": ("frames.parquet", load_frames),
    "size of an image": ("a.png", lambda folder: image_size(folder / "a.png")),
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("what", ["a pipe", "nested deeply"])
def test_an_untrusted_file_is_refused_or_ignored(name: str, what: str, tmp_path: Path) -> None:
    relative, read = READERS[name]
    file = tmp_path / relative
    file.parent.mkdir(exist_ok=True)
    if what == "a pipe":
        os.mkfifo(file)
    else:
        file.write_text(DEEP)
    try:
        found = read(tmp_path)
    except CleargsError as error:
        assert "\n" not in str(error) and error.hint
    else:
        assert not found
