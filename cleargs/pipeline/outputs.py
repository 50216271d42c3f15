"""Check output paths: no command replaces an input of a run, or its settings and results."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from os.path import realpath
from pathlib import Path

from cleargs.errors import CleargsError, InputError
from cleargs.named_views import VIEWS
from cleargs.packed import PACK
from cleargs.pipeline.run_file import LOCK, RUN_FILE, SCENE, known_metadata, read_run_file
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import ROOTS, STORE_FOLDER

OWN = (RUN_FILE, SCENE, LOCK, PACK, STORE_FOLDER, "run.log", VIEWS, "report.html", "report")
"""Files and folders that every run has, in addition to the results of its stages."""

NEAR = 4
"""Number of folders above an output in which runs are searched that may have it as an input."""


CAPTURE = ("images", "masks", "sparse", "colmap")
"""Folders of a capture in which nothing is written: a new file would become a part of it."""


def check_outputs(
    outputs: Iterable[Path],
    dag: Stages,
    run: Path | None = None,
    *,
    inputs: Iterable[Path] = (),
    force: bool = True,
) -> None:
    """Raise InputError if one of the ``outputs`` must not be written, also with ``--force``.

    An output may not be, or be in, an input of ``run``, one of the ``inputs`` of the command, or one of the
    `own_places` of a run. It may not replace an input of another run next to it. Links, hard links, and the
    recorded path of an input that was moved count too. Without ``force``, it may not exist.
    """
    inputs = tuple(inputs)
    for output in outputs:
        written = Place(output)
        for place, what in _protected(output, dag, run, inputs):
            if written.is_inside(place):
                where = f"in {place}, " if place.is_dir() else ""
                hint = "choose another name or folder"
                raise InputError(f"{output} is {where}{what}, and is never replaced", hint=hint)
        if not force and output.exists():
            raise InputError(f"{output} exists already", hint="choose another name, or give --force")


def _protected(
    output: Path, dag: Stages, run: Path | None, inputs: Iterable[Path]
) -> Iterator[tuple[Path, str]]:
    """Yield the places in which ``output`` may not be, and their meanings."""
    yield from ((place, "an input of this command") for place in inputs)
    runs = [] if run is None else [run]
    for folder in (folder for name in _names(output) for folder in name.parents[:NEAR]):
        files = [folder / RUN_FILE, *(folder.glob(f"*/{RUN_FILE}") if output.exists() else ())]
        runs += [file.parent for file in files if file.is_file()]
    for one in dict.fromkeys(runs):
        yield from ((place, f"part of the run {one}") for place in own_places(one, dag))
        if one == run or output.exists():
            yield from ((place, f"an input of the run {one}") for place in _inputs_of(one, dag, one == run))


def own_places(run: Path, dag: Stages, store: Path | None = None) -> Iterator[Path]:
    """Yield the files and folders of ``run`` and its ``store`` (default: that in ``run.toml``)."""
    yield from (run / name for name in (*OWN, *dag.names))
    if store := store or known_metadata(run).store:
        yield from (store / name for name in (*dag.names, ROOTS, "work", "kept", "locks", "digests.sqlite"))


def _inputs_of(run: Path, dag: Stages, whole: bool) -> Iterator[Path]:
    """Yield the capture of ``run`` and the other files that its stages read outside the store.

    With ``whole``, all of a folder that was given as the capture counts, unless the run is in it.
    """
    source = known_metadata(run).source
    if source is None or (run / PACK).is_file():  # a packed run holds only the name of its capture
        return
    if not source.is_dir() or (whole and not Place(run).is_inside(source)):
        yield source
    yield from (source / name for name in CAPTURE if (source / name).is_dir())
    with suppress(CleargsError, OSError):  # a setting may be unknown
        config = read_run_file(run, dag).config.effective
        for name in dag.names:
            with suppress(CleargsError, OSError):  # the capture may be gone
                for place in dag.load(name).externals(config[name], source).values():
                    yield from (place,) if isinstance(place, Path) else place.values()


class Place:
    """A path that may be written, and all its names: without links and ``..``, and by identity."""

    def __init__(self, path: Path, *, hard_links: bool = True) -> None:
        self._names = _names(path)
        self._around = {_identity(one) for way in self._names for one in (way, *way.parents)} - {None}
        shared = hard_links and path.is_file() and path.stat().st_nlink > 1
        self._file = _identity(path) if shared else None

    def is_inside(self, place: Path) -> bool:
        """Return True if the path, which need not exist, is ``place``, is in it, or links to something in it.

        Other spellings of a name on file systems that ignore case are found, and ``hard_links`` if wanted.
        """
        if any(way.is_relative_to(name) for way in self._names for name in _names(place)):
            return True
        # Nothing is looked up through a link in a run, which may come from another user.
        linked = place.is_symlink() or place.parent.is_symlink()
        walked = self._file is not None and not linked and place.is_dir()
        found = os.walk(place) if walked else ()
        files = (Path(folder, name) for folder, _, names in found for name in names)
        return _identity(place) in self._around or any(_identity(file) == self._file for file in files)


def _names(path: Path) -> set[Path]:
    return {Path(realpath(path.parent), path.name), Path(realpath(path))}  # unlike resolve(), allows loops


def _identity(path: Path) -> tuple[int, int] | None:
    with suppress(OSError):
        status = path.stat()
        return status.st_dev, status.st_ino
    return None
