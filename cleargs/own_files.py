"""Files of a run folder or a store, which are opened and listed without following links.

Another person may have sent the folder. A link in it could lead to any file of the user. The folder itself
may be a link, because the user named it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from cleargs.errors import StoreError
from cleargs.files import PARTIAL_SUFFIX, atomic_path, is_free
from cleargs.safe_io import open_own, read_bytes

ABANDONED_S = 3600.0
"""Seconds without a change after which a partial file is a leftover. Living writers write more often."""


def nodes_below(folder: Path) -> Iterator[os.DirEntry[str]]:
    """Yield what is below ``folder`` and is not a folder. Links are not followed; ``folder`` may be one.

    A folder that does not exist has none. Raises OSError if a folder cannot be read.
    """
    waiting = [os.fspath(folder)]
    while waiting:
        with suppress(FileNotFoundError, NotADirectoryError), os.scandir(waiting.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)
                else:
                    yield entry


def regular_files(folder: Path) -> list[Path]:
    """Return the files below ``folder`` in order, without links and what is behind them."""
    return sorted(Path(node.path) for node in nodes_below(folder) if node.is_file(follow_symlinks=False))


def has_only_files(folder: Path) -> bool:
    """Return True if ``folder`` is a folder without links, FIFOs and devices, which can be read."""
    try:
        nodes = nodes_below(folder)
        return (
            folder.is_dir()
            and not folder.is_symlink()
            and all(x.is_file(follow_symlinks=False) for x in nodes)
        )
    except OSError:
        return False


def size_of(path: Path) -> int:
    """Return the size of a file, or the total size of the files below a folder, in bytes."""
    files = regular_files(path) if path.is_dir() and not path.is_symlink() else [path]
    return sum(file.lstat().st_size for file in files)


def drop_links(folder: Path, in_place: Path) -> None:
    """Delete the links, FIFOs and devices below ``folder``. Nothing behind them changes.

    Programs write into the files outside of ``in_place`` without replacing them. Those with a second name
    (hard link) are deleted too.
    """
    if folder.is_symlink():
        folder.unlink()
    for node in list(nodes_below(folder)):
        shared = node.stat(follow_symlinks=False).st_nlink > 1 and in_place not in Path(node.path).parents
        if shared or not node.is_file(follow_symlinks=False):
            Path(node.path).unlink()


def append_own(path: Path, text: str) -> None:
    """Append to the file ``path``, or create it. A file with a second name (hard link) is copied first.

    Raises OSError if it is not a regular file.
    """
    with os.fdopen(open_own(path, path.parent, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "a") as file:
        if os.fstat(file.fileno()).st_nlink == 1:
            file.write(text)
            return
    with atomic_path(path) as copy:
        copy.write_bytes(read_bytes(path, root=path.parent) + text.encode())


def refuse_links(paths: Iterable[Path]) -> None:
    """Raise StoreError if one of ``paths`` is a link, a FIFO or a device."""
    for path in paths:
        if path.is_symlink() or (path.exists() and not path.is_file() and not path.is_dir()):
            raise StoreError(
                f"{path} is a link or a device, which ClearGS does not use",
                hint="remove it, or put the file or folder itself in its place",
            )


def leftovers(folder: Path, name: str = "*") -> list[Path]:
    """Return the partial files and folders in ``folder`` of processes that died while they wrote ``name``.

    Files count if they did not change for `ABANDONED_S`, because they have no locks. If the file system has
    no locks, no folder is returned.
    """
    found = sorted(folder.glob(f".{'[0-9a-f]' * 8}{PARTIAL_SUFFIX}.{name}"))
    return [path for path in found if not path.is_symlink() and (_is_abandoned(path) or is_free(path))]


def _is_abandoned(path: Path) -> bool:
    return path.is_file() and time.time() - path.stat().st_mtime > ABANDONED_S
