"""Files that are either whole or not there: written beside their place, flushed to disk, renamed into it."""

from __future__ import annotations

import errno
import json
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

from cleargs.errors import StoreError

External: TypeAlias = Path | Mapping[str, Path]
"""Files outside the store: one, all of a folder that are not hidden, or single ones by name."""

PARTIAL_SUFFIX = ".partial"
"""Ending of a file that is being written; whoever finds one may delete it."""


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path that becomes ``path`` when the block ends without an error.

    The temporary file keeps the extension of ``path`` (image writers choose their format by it). A writer
    that dies leaves ``path`` as it was, and of several writers at once, in threads, processes or on nodes
    that share the disk, the last one wins. Raises StoreError when the disk is full or not writable.
    """
    temporary = path.with_name(f".{secrets.token_hex(4)}{PARTIAL_SUFFIX}.{path.name}")
    try:
        with disk_errors(path):
            yield temporary
            sync(temporary)
            temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def whole_folder(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield a new folder that becomes ``path`` when the block ends without an error.

    With ``replace`` it takes the place of an older one. Raises StoreError when it cannot be written.
    """
    folder = path.with_name(f".{secrets.token_hex(4)}{PARTIAL_SUFFIX}.{path.name}")
    old = folder.with_name(f"{folder.name}.old")
    try:
        with disk_errors(path):
            folder.mkdir()
            yield folder
            if replace and path.exists():
                path.rename(old)
            folder.rename(path)
            shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def is_partial(path: Path) -> bool:
    """Whether ``path`` is a leftover of a writer that died."""
    return path.name.startswith(".") and PARTIAL_SUFFIX in path.name


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON with sorted keys, atomically."""
    write_bytes(path, (json.dumps(value, indent=2, sort_keys=True, ensure_ascii=False) + "\n").encode())


def make_folder(path: Path, *, empty: bool = False) -> None:
    """Have a folder at ``path``, in place of a file that lies there; ``empty`` also without what is in it."""
    if empty or path.is_symlink() or not path.is_dir():
        remove(path)
    path.mkdir(parents=True, exist_ok=True)


def remove(path: Path) -> None:
    """Have nothing at ``path``: neither a file, nor a link, nor a folder and all in it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def sync_tree(folder: Path) -> None:
    """Have the folder and all in it on the disk: a rename of it then shows all or nothing."""
    for path in [*folder.rglob("*"), folder]:
        sync(path)


def sync(path: Path) -> None:
    """Have the file or folder ``path`` on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """While ``path`` is written: what the system refuses becomes the StoreError that says what to do."""
    try:
        yield
    except OSError as error:
        raise disk_error(error, path) from error


def disk_error(error: OSError, path: Path) -> StoreError:
    """The StoreError that says what to do about a failed write of ``path``."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StoreError(
            f"no space left on the disk of {path.parent}", hint="free some space, or choose another --store"
        )
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return StoreError(
            f"cannot write to {path.parent}: {error.strerror}", hint="choose a folder that you may write to"
        )
    too_long = error.errno == errno.ENAMETOOLONG
    return StoreError(
        f"cannot write {path}: {error.strerror or error}",
        hint="choose a shorter path" if too_long else "check the disk and its permissions",
    )
