"""Atomic writes: a file is written under a temporary name, flushed to disk, and renamed."""

from __future__ import annotations

import errno
import json
import os
import secrets
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

from cleargs.errors import StoreError

External: TypeAlias = Path | Mapping[str, Path]
"""Files outside the store: a file, a folder (its files that are not hidden), or files by name."""

PARTIAL_SUFFIX = ".partial"
"""Part of the name of a file or folder that is being written. A leftover one may be deleted."""


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path that becomes ``path`` when the block ends without an error.

    The temporary file has the extension of ``path``, by which image writers choose their format. A writer
    that dies leaves ``path`` unchanged. If several write at once, the last one wins. Raises StoreError if the
    disk is full or not writable.
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

    With ``replace``, it replaces a folder at ``path``. Raises StoreError if it cannot be written.
    """
    folder = path.with_name(f".{secrets.token_hex(4)}{PARTIAL_SUFFIX}.{path.name}")
    old = folder.with_name(f"{folder.name}.old")
    try:
        with disk_errors(path):
            folder.mkdir()
            with _locked(folder):
                yield folder
                if replace and path.exists():
                    path.rename(old)
                folder.rename(path)
            shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _locked(folder: Path) -> Iterator[bool | None]:
    """Hold the lock of a folder. Yields the result of `acquire_lock`."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        yield acquire_lock(handle, shared=False, wait=False)
    finally:
        os.close(handle)


def is_free(partial: Path) -> bool:
    """Return True if the process that wrote a folder of `whole_folder` has died.

    A living process holds its lock. It needs less than a second to get it.
    """
    with suppress(OSError), _locked(partial) as locked:
        return locked is True and time.time() - partial.stat().st_mtime > 1.0
    return False


def acquire_lock(handle: int, *, shared: bool, wait: bool) -> bool | None:
    """Lock an open file or folder until it is closed. Return False if another process holds a lock.

    None means that the file system, or this Python, has no locks.
    """
    try:
        import fcntl
    except ImportError:
        return None
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(handle, kind if wait else kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def is_partial(path: Path) -> bool:
    """Return True if ``path`` is a leftover of a writer that died."""
    return path.name.startswith(".") and PARTIAL_SUFFIX in path.name


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON with sorted keys, atomically."""
    write_bytes(path, (json.dumps(value, indent=2, sort_keys=True, ensure_ascii=False) + "\n").encode())


def link_or_copy(file: Path, path: Path) -> None:
    """Make a symbolic link to ``file`` at ``path``, or a copy on a disk without links (exFAT, FAT32, SMB).

    A relative ``file`` is relative to the folder of ``path``.
    """
    try:
        path.symlink_to(file)
    except OSError:
        shutil.copyfile(path.parent / file, path)  # FAT32 refuses to copy permissions


def make_folder(path: Path, *, empty: bool = False) -> None:
    """Create a folder at ``path``, replacing a file or link; with ``empty``, delete what is in the folder."""
    if empty or path.is_symlink() or not path.is_dir():
        remove(path)
    path.mkdir(parents=True, exist_ok=True)


def remove(path: Path) -> None:
    """Delete the file, link or whole folder at ``path``, if there is one."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def sync_tree(folder: Path) -> None:
    """Flush a folder and all files in it to disk, so that a later rename shows all of them or none."""
    for path in [*folder.rglob("*"), folder]:
        sync(path)


def sync(path: Path) -> None:
    """Flush the file or folder ``path`` to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn an OSError while ``path`` is written into the StoreError of `disk_error`."""
    try:
        yield
    except OSError as error:
        raise disk_error(error, path) from error


def disk_error(error: OSError, path: Path) -> StoreError:
    """Return the StoreError, with a hint, for a failed write of ``path``."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return no_space(path.parent)
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return StoreError(
            f"cannot write to {path.parent}: {error.strerror}", hint="choose a folder that you may write to"
        )
    too_long = error.errno == errno.ENAMETOOLONG
    return StoreError(
        f"cannot write {path}: {error.strerror or error}",
        hint="choose a shorter path" if too_long else "check the disk and its permissions",
    )


def no_space(folder: Path) -> StoreError:
    """Return the StoreError for a full disk, where space or file numbers (inodes) are used up."""
    what, remedy = "space", "free some space (cleargs gc)"
    with suppress(OSError):
        disk = os.statvfs(next(place for place in (folder, *folder.parents) if place.exists()))
        if disk.f_files and not disk.f_favail and disk.f_bavail:
            what, remedy = "room for more files (inodes)", "delete some files (cleargs gc)"
    return StoreError(f"no {what} left on the disk of {folder}", hint=f"{remedy}, or choose another --store")
