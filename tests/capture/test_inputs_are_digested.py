"""The digest of an input covers every file that its readers resolve: a change is never missed."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from cleargs.capture.sources import externals, open_capture
from cleargs.digest import DigestMemo
from cleargs.errors import InputError
from cleargs.stages.ingest import IngestConfig

from .conftest import Ingest


def moved(posed: Path, place: str, listed: str, key: str = '"file_path"') -> Path:
    """Move the first image to ``place``, list it as ``listed`` in transforms.json, and return its path."""
    file = posed / place
    file.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(posed / "images" / "000.png", file)
    text = (posed / "transforms.json").read_text()
    text = text.replace('"file_path": "images/000.png"', f"{key}: {json.dumps(listed)}")
    (posed / "transforms.json").write_text(text)
    return file


ELSEWHERE: dict[str, Callable[[Path], Path]] = {
    "beside the capture": lambda posed: moved(posed, "../x/000.png", "../x/000.png"),
    "absolute": lambda posed: moved(posed, "../x/000.png", str(posed.parent / "x" / "000.png")),
    "through images": lambda posed: moved(posed, "frames2/000.png", "images/../frames2/000.png"),
    "hidden file": lambda posed: moved(posed, "images/.000.png", "images/.000.png"),
    "hidden folder": lambda posed: moved(posed, "images/.old/000.png", "images/.old/000.png"),
    "backslashes": lambda posed: moved(posed, "../x/000.png", "..\\x\\000.png"),
    "escaped key": lambda posed: moved(posed, "../x/000.png", "../x/000.png", r'"file\u005fpath"'),
    "no extension": lambda posed: moved(posed, "../x/000.png", "../x/000"),
}


def digests(folder: Path, memo: DigestMemo) -> dict[str, dict[str, str]]:
    return {role: memo.digests_of(place) for role, place in externals(folder, IngestConfig()).items()}


@pytest.mark.parametrize("how", ELSEWHERE)
def test_a_listed_image_counts_wherever_it_lies(posed: Path, tmp_path: Path, how: str) -> None:
    file = ELSEWHERE[how](posed)
    assert file.resolve() in {frame.path.resolve() for frame in open_capture(posed, IngestConfig()).frames}
    with DigestMemo(tmp_path / "memo.json") as memo:
        before = digests(posed, memo)
        cv2.imwrite(str(file), np.zeros((240, 320, 3), np.uint8))
        assert digests(posed, memo) != before


def test_a_listed_mask_counts_wherever_it_lies(posed: Path, tmp_path: Path) -> None:
    data = json.loads((posed / "transforms.json").read_text())
    data["frames"][0]["mask_path"] = "../mask.png"
    (posed / "transforms.json").write_text(json.dumps(data))
    cv2.imwrite(str(posed.parent / "mask.png"), np.full((240, 320), 255, np.uint8))
    with DigestMemo(tmp_path / "memo.json") as memo:
        before = digests(posed, memo)
        cv2.imwrite(str(posed.parent / "mask.png"), np.zeros((240, 320), np.uint8))
        assert digests(posed, memo) != before


@pytest.mark.parametrize("name", ["../other/000.png", ".hidden/000.png", "/000.png"])
def test_a_colmap_model_lists_no_image_outside_its_folder(posed: Path, ingest: Ingest, name: str) -> None:
    """No digest covers files outside images/: a change there would be missed."""
    project = ingest(posed).out
    model = project / "colmap" / "sparse" / "0" / "images.bin"
    model.write_bytes(model.read_bytes().replace(b"000000.png\0", name.encode() + b"\0"))
    with pytest.raises(InputError, match="outside images/"):
        open_capture(project, IngestConfig())


@pytest.mark.parametrize("what", ["fifo", "device", "broken link"])
@pytest.mark.parametrize("name", ["view3.png", "notes.txt"])
def test_what_is_no_regular_file_is_left_out_by_name(images: Path, what: str, name: str) -> None:
    place = images / name
    place.unlink(missing_ok=True)
    if what == "fifo":
        os.mkfifo(place)
    else:
        place.symlink_to("/dev/zero" if what == "device" else "gone.png")
    capture = open_capture(images, IngestConfig())
    named = "1 file that cannot be opened (view3.png)"
    assert (named in capture.told) == any(named in note for note in capture.notes) == (name == "view3.png")
    assert len(capture.frames) == 9 + (name != "view3.png")
    externals(images, IngestConfig())


@pytest.mark.parametrize("name", ["masks/view3.png", "masks/notes.txt"])
def test_a_mask_that_is_no_regular_file_is_named_at_once(images: Path, tmp_path: Path, name: str) -> None:
    (images / "masks").mkdir()
    os.mkfifo(images / name)
    with DigestMemo(tmp_path / "memo.json") as memo, pytest.raises(InputError, match="not a regular file"):
        digests(images, memo)
