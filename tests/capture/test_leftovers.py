"""Damaged files of a killed ingest: they are removed with a warning, and the results are the same."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from cleargs.capture import sfm
from cleargs.capture.sfm_job import OUTCOME
from cleargs.digest import file_digest
from cleargs.files import remove
from cleargs.manifest import published_files

from .conftest import Ingest


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def empty(file: Path) -> None:
    file.write_bytes(b"")


def garbage(file: Path) -> None:
    file.write_bytes(b"\xff\x07" * 700)


def a_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def a_file(folder: Path) -> None:
    remove(folder)
    folder.write_bytes(b"no folder")


MODEL = ["cameras.bin", "images.bin", "points3D.bin"]
DAMAGES: dict[str, Callable[[Path, Path], object]] = {
    "empty working image": lambda work, out: empty(work / "images" / "000003.png"),
    "cut working image": lambda work, out: cut(work / "images" / "000003.png"),
    "a folder for a working image": lambda work, out: a_folder(work / "images" / "000003.png"),
    "empty published image": lambda work, out: empty(out / "images" / "000003.png"),
    "a file for the working images": lambda work, out: a_file(work / "images"),
    "a file for the published images": lambda work, out: a_file(out / "images"),
    "a file for the model": lambda work, out: a_file(work / "model"),
    "model without its outcome": lambda work, out: (work / "model" / OUTCOME).unlink(),
    "empty outcome": lambda work, out: empty(work / "model" / OUTCOME),
    **{f"empty {name}": lambda work, out, name=name: empty(work / "model" / name) for name in MODEL},
    **{f"garbage {name}": lambda work, out, name=name: garbage(work / "model" / name) for name in MODEL},
}


def digests(out: Path) -> dict[str, str]:
    return {name: file_digest(file) for name, file in published_files(out).items()}


@pytest.fixture
def settings() -> dict[str, int]:
    """Small images: COLMAP may start again after a damage."""
    return {"feature_size": 160, "max_size": 160, "max_features": 256}


@pytest.mark.parametrize("what", DAMAGES)
def test_damaged_leftovers(
    posed: Path, ingest: Ingest, tmp_path: Path, settings: dict[str, int], what: str
) -> None:
    first = ingest(posed, **settings)
    healthy = digests(first.out)
    remove(tmp_path / "kept")
    DAMAGES[what](tmp_path / "out.work", tmp_path / "out")
    again = ingest(posed, **settings)
    assert digests(again.out) == healthy
    silent = (
        what.startswith("a file for the working") or "published" in what
    )  # these are always written again
    assert (again.warnings != first.warnings) != silent, again.warnings


def test_a_damaged_database_is_made_again(
    posed: Path, ingest: Ingest, tmp_path: Path, settings: dict[str, int]
) -> None:
    healthy = digests(ingest(posed, **settings).out)
    for damage in (empty, cut, garbage):
        remove(tmp_path / "out.work" / "model")
        remove(tmp_path / "kept")
        damage(tmp_path / "out.work" / "database.db")
        assert digests(ingest(posed, **settings).out) == healthy


def test_a_model_that_does_not_say_how_frames_were_placed_is_made_again(
    images: Path, ingest: Ingest, tmp_path: Path, settings: dict[str, int]
) -> None:
    healthy = digests(ingest(images, **settings).out)
    for damage in (empty, garbage, Path.unlink):
        remove(tmp_path / "kept")
        damage(tmp_path / "out.work" / "model" / OUTCOME)
        assert digests(ingest(images, **settings).out) == healthy


@pytest.mark.slow  # about 5 s of one core: COLMAP runs four times
def test_other_held_out_frames_need_no_new_poses(
    posed: Path, ingest: Ingest, tmp_path: Path, settings: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search took minutes, for poses that do not depend on the frames that are held out."""
    fresh = digests(ingest(posed, "fresh", **settings, holdout="every:4").out)
    remove(tmp_path / "kept")
    ingest(posed, "first", **settings)
    searches: list[str] = []
    searched = sfm.run_child
    monkeypatch.setattr(sfm, "run_child", lambda *given: (searches.append(given[0]), searched(*given)))
    again = ingest(posed, "again", **settings, holdout="every:4")
    assert searches == [] and any("earlier run" in line for line in again.infos)
    assert digests(again.out) == fresh and digests(again.out) != digests(tmp_path / "first")
    (kept,) = (tmp_path / "kept").iterdir()
    cut(kept)
    assert digests(ingest(posed, "damaged", **settings, holdout="every:4").out) == fresh
    assert len(searches) == 1


def test_foreign_images_and_masks_are_not_published(
    posed: Path, ingest: Ingest, tmp_path: Path, settings: dict[str, int]
) -> None:
    """A mask that this capture does not have would hide parts of its frame from every later stage."""
    healthy = digests(ingest(posed, **settings).out)
    out = tmp_path / "out"
    (out / "masks").mkdir()
    image = (out / "images" / "000003.png").read_bytes()
    for place in ("images/000999.png", "images/notes.txt", "masks/000003.png"):
        (out / place).write_bytes(image)
    assert digests(ingest(posed, **settings).out) == healthy
