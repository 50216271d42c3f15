"""Content digests of files and folders, and a memo that saves hashing the same file twice."""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import time
from collections.abc import Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, TypeAlias

from cleargs.errors import InputError
from cleargs.files import External
from cleargs.safe_io import open_regular, require_utf8

RACY_NS = 2_000_000_000
"""A file changed less than this long ago may change again within one tick of its time stamp: not memoised."""

COLUMNS = "size, mtime_ns, ctime_ns, inode, digest"
"""Of the memo, after the path."""

_Row: TypeAlias = tuple[int, int, int, int, str]

NOTHING: _Row = (-1, -1, -1, -1, "")
"""The row of a file of which nothing is known: no file has such a state."""


def json_digest(value: Any) -> str:
    """sha256 of ``value`` as JSON with sorted keys and no spaces; NaN and infinities are refused."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def file_digest(path: Path) -> str:
    """sha256 of the bytes of a regular file, hexadecimal. Raises OSError like `open_regular`."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def tree_digest(files: Mapping[str, str]) -> str:
    """One digest for many files: ``files`` maps each relative path (POSIX) to the digest of its content."""
    return json_digest(dict(files))


def files_under(path: Path) -> dict[str, Path]:
    """Relative POSIX path -> file, for each file in the folder ``path`` that is not hidden."""
    found = {}
    for folder, folders, names in os.walk(path, followlinks=True):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            if not name.startswith("."):
                file = Path(folder, name)
                found[file.relative_to(path).as_posix()] = file
    return found


class DigestMemo:
    """Digests by path, size, inode, and times of content (mtime) and state (ctime), kept in an SQLite file.

    Any program may set mtime; ctime only the kernel sets, at every write and also where mtime is put back.

    The memo only saves time: where its file is damaged, locked or not writable, digests are computed
    afresh and nobody is troubled. The file is read at once and written at the end, if its folder is there by
    then.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: dict[str, _Row] = {}
        self._learnt: dict[str, _Row] = {}
        if path.exists():
            with suppress(sqlite3.Error), closing(sqlite3.connect(path, timeout=5)) as database:
                rows = database.execute(f"SELECT path, {COLUMNS} FROM contents")
                self._known = {row[0]: row[1:] for row in rows}

    def __enter__(self) -> DigestMemo:
        return self

    def __exit__(self, *raised: object) -> None:
        """Write what was learnt."""
        if not self._learnt or not self._path.parent.is_dir():
            return
        try:
            self._write()
        except sqlite3.OperationalError:
            pass  # locked, or not writable: the next run hashes again
        except sqlite3.DatabaseError:  # damaged: an empty one takes its place
            with suppress(OSError, sqlite3.Error):
                self._path.unlink(missing_ok=True)
                self._write()

    def digest(self, path: Path) -> str:
        """The digest of the file at ``path``: remembered where size, times and inode are unchanged."""
        name, state = _state(path)
        known = self._learnt.get(name) or self._known.get(name)
        if known is not None and known[:4] == state:
            return known[4]
        digest = file_digest(path)
        if time.time_ns() - max(state[1:3]) > RACY_NS:
            self._learnt[name] = (*state, digest)
        return digest

    def remember(self, path: Path, digest: str) -> None:
        """Note the digest of a file that nobody will write again."""
        name, state = _state(path)
        self._learnt[name] = (*state, digest)

    def forget(self, path: Path) -> None:
        """Drop what is known of ``path``, so that the next `digest` reads the file."""
        self._learnt[str(path.absolute())] = NOTHING

    def digests_of(self, place: External, *, rehash: bool = False) -> dict[str, str]:
        """Relative path -> digest for a folder, {"": digest} for a file, name -> digest for files by name.

        With ``rehash`` every file is read, whatever is known of it. Raises InputError when a file is missing
        or not regular, cannot be read, or has a name that is not UTF-8.
        """
        files = named_files(place)
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

    def _write(self) -> None:
        rows = [(name, *row) for name, row in self._learnt.items()]
        with closing(sqlite3.connect(self._path, timeout=5)) as database, database:
            database.execute(f"CREATE TABLE IF NOT EXISTS contents (path TEXT PRIMARY KEY, {COLUMNS})")
            database.executemany("INSERT OR REPLACE INTO contents VALUES (?, ?, ?, ?, ?, ?)", rows)


def named_files(place: External) -> dict[str, Path]:
    """Every file of ``place`` by the name under which its digest is noted."""
    if isinstance(place, Mapping):
        return dict(place)
    return files_under(place) if place.is_dir() else {"": place}


def _state(path: Path) -> tuple[str, tuple[int, int, int, int]]:
    status = path.stat()
    return str(path.absolute()), (status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino)
