"""Content digests of files and folders, and a memo that avoids hashing a file twice."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

from cleargs.errors import InputError, StoreError
from cleargs.files import External, write_bytes
from cleargs.safe_io import FAULTS, open_regular, read_json, require_utf8

RACY_NS = 2_000_000_000
"""Nanoseconds. A file that changed less than this ago is not memoised: it may change again within one tick of
its time stamp, which is up to 2 s (FAT)."""

MAX_ROWS = 500_000
"""Maximum number of files in the memo. Those that were read last are kept."""

_Row: TypeAlias = tuple[int, int, int, int, str]

MAX_FILES = 100_000
"""Maximum number of files and folders below an input. A home folder or a whole disk, which a `run.toml` of
another person may name, is not searched to its end."""

RESULTS = ("run.toml", "cfg_args", "locks/store.lock")
"""Files by which results of ClearGS (runs, stores) and of trainers that follow Inria's are known."""

NOTHING: _Row = (-1, -1, -1, -1, "")
"""The row of a forgotten file. It matches no file, since sizes and times are not negative."""


def json_digest(value: Any) -> str:
    """Return the SHA-256 (hex) of ``value`` as JSON with sorted keys; raise ValueError for NaN, infinity."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a regular file, in hexadecimal. Raises OSError like `open_regular`."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def tree_digest(files: Mapping[str, str]) -> str:
    """Return one digest for many files, given as relative POSIX path -> digest of the content."""
    return json_digest(dict(files))


def is_inside(name: str) -> bool:
    """Return True if a listed ``name`` stays in its folder and is not hidden.

    Only such files are part of a folder's digest.
    """
    path = PurePosixPath(name)
    return not path.is_absolute() and not any(part.startswith(".") for part in path.parts)


def files_under(path: Path, left_out: Callable[[Path], bool] = lambda folder: False) -> dict[str, Path]:
    """Return relative POSIX path -> file, for all files below the folder ``path`` that are not hidden.

    Each folder is entered once, by its own name if it also has links: links may form loops. Folders with
    results (`has_results`), and those for which ``left_out`` is True, are not entered. Raises InputError if
    there are more than `MAX_FILES`.
    """
    found, entered, folders, links, seen = {}, set(), [path], list[Path](), 0
    while folders or links:
        folder = folders.pop() if folders else links.pop()
        with suppress(OSError):  # a folder that may not be read has no files
            status = folder.stat()
            if (status.st_dev, status.st_ino) in entered:
                continue
            entered.add((status.st_dev, status.st_ino))
            for place in sorted(folder.iterdir(), reverse=True):
                if (seen := seen + 1) > MAX_FILES:
                    raise InputError(
                        f"{path} has more than {MAX_FILES:,} files, so it is not one capture",
                        hint="give the folder of the images, or the video",
                    )
                if place.name.startswith("."):
                    continue
                if place.is_dir():
                    if left_out(place) or has_results(place):
                        continue
                    (links if place.is_symlink() else folders).append(place)
                else:
                    found[place.relative_to(path).as_posix()] = place
    return found


def has_results(folder: Path) -> bool:
    """Return True if ``folder`` is a run, a store, or the results of another trainer: never an input."""
    return any((folder / name).is_file() for name in RESULTS)


class DigestMemo:
    """A cache of digests by path, size, inode, mtime and ctime, stored in a JSON file.

    Any program can set mtime. Only the kernel sets ctime: at every write, and also when mtime is set back. If
    the file is damaged or not writable, digests are computed again, and no error is raised. It is read at the
    start and replaced at the end, if its folder exists by then. Rows that another process added in between
    may be lost.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known = self._read()
        self._learnt: dict[str, _Row] = {}

    def __enter__(self) -> DigestMemo:
        return self

    def __exit__(self, *raised: object) -> None:
        if not self._learnt or not self._path.parent.is_dir():
            return
        rows = [*(self._read() | self._learnt).items()][-MAX_ROWS:]
        with suppress(StoreError):  # not writable: the next run hashes again
            text = json.dumps({name: row for name, row in rows if row != NOTHING}, separators=(",", ":"))
            write_bytes(self._path, text.encode())

    def digest(self, path: Path) -> str:
        """Return the digest of the file at ``path``, from the memo if size, times and inode are unchanged."""
        name, state = _state(path)
        known = self._learnt.get(name) or self._known.get(name)
        if known is not None and known[:4] == state:
            return known[4]
        digest = file_digest(path)
        if time.time_ns() - max(state[1:3]) > RACY_NS:
            self._learnt[name] = (*state, digest)
        return digest

    def remember(self, path: Path, digest: str) -> None:
        """Store the digest of a file that is not written again, however recent its last change is."""
        name, state = _state(path)
        self._learnt[name] = (*state, digest)

    def forget(self, path: Path) -> None:
        """Drop the digest of ``path``, so that the next `digest` reads the file."""
        self._learnt[str(path.absolute())] = NOTHING

    def digests_of(self, external: External, *, rehash: bool = False) -> dict[str, str]:
        """Return the digests of files outside the store. With ``rehash``, read every file again.

        They are ``{"": digest}`` for a file, relative path -> digest for a folder, or name -> digest.
        InputError is raised if a file is missing, not regular or not readable, or if its name is not UTF-8.
        """
        files = named_files(external)
        for file in files.values():
            require_utf8(file)
            if rehash:
                self.forget(file)
        try:
            return {name: self.digest(file) for name, file in files.items()}
        except OSError as error:
            raise InputError(
                f"cannot read {error.filename}: {error.strerror or error}",
                hint="check the path and its permissions, or remove it from the input",
            ) from error

    def _read(self) -> dict[str, _Row]:
        """Return path -> row of the files that were read before; nothing if the file cannot be used."""
        with suppress(*FAULTS):
            rows = read_json(self._path, root=self._path.parent).items()
            return {name: (size, m, c, inode, digest) for name, (size, m, c, inode, digest) in rows}
        return {}


def named_files(external: External) -> dict[str, Path]:
    """Return the files of ``external`` by the names that `DigestMemo.digests_of` gives them."""
    if isinstance(external, Mapping):
        return dict(external)
    return files_under(external) if external.is_dir() else {"": external}


def _state(path: Path) -> tuple[str, tuple[int, int, int, int]]:
    status = path.stat()
    return str(path.absolute()), (status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino)
