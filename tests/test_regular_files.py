"""Untrusted documents: a pipe does not block their readers, and deep nesting does not crash them."""

from __future__ import annotations

import os
import subprocess
import sys
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


def test_reading_reserves_no_more_memory_than_the_file_needs(tmp_path: Path) -> None:
    """Every read reserved the limit of 4 GiB, so that a run failed with 4 GB of addresses."""
    (tmp_path / "small").write_text("content")
    limited = (
        "import resource; from pathlib import Path; from cleargs.safe_io import read_bytes\n"
        "resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31))\n"
        f"print(read_bytes(Path({str(tmp_path / 'small')!r})).decode(), read_bytes(Path('/proc/stat'))[:3])"
    )
    told = subprocess.run([sys.executable, "-c", limited], capture_output=True, text=True, check=False)
    assert told.stdout == "content b'cpu'\n", told.stderr
