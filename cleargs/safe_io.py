"""Safe reading of untrusted files: only regular files, only up to a size limit, and no control characters.

A FIFO or a device could block its reader or never end. A wrong size, count or depth could exhaust the memory.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import struct
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

from cleargs.errors import CleargsError, InputError

MAX_BYTES = 4 * 2**30
"""Maximum size of a file that is read as a whole (an image, a sparse model, a scene, a network)."""

MAX_TEXT_BYTES = 256 * 2**20
"""Maximum size of a document (JSON, TOML, CSV). A transforms.json of 100,000 frames has 80 MB."""

FAULTS: tuple[type[Exception], ...] = (
    OSError,
    ValueError,  # includes UnicodeDecodeError and JSONDecodeError
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,  # includes OverflowError and ZeroDivisionError
    RecursionError,
    struct.error,
)
"""Exceptions that decoding a malformed file may raise. Each reader turns them into its own error."""


_HARMFUL = ("Cc", "Cs", "Zl", "Zp")
"""Unicode categories that a terminal acts on or cannot show: control characters, surrogates, line separators
and paragraph separators."""

_BIDI = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
"""Characters that reorder the text around them, so that one name may look like another."""

TOO_DEEP = "it is nested too deeply"


def open_regular(path: Path, root: Path | None = None) -> BufferedReader:
    """Open the regular file at ``path``, or the one that it links to, for reading. ``root``: see `open_own`.

    Raises OSError if the file is missing or not readable, or if it is a folder, a FIFO or a device.
    """
    return os.fdopen(open_own(path, root), "rb")


def open_own(path: Path, root: Path | None, flags: int = os.O_RDONLY) -> int:
    """Return a descriptor of the regular file at ``path``. Raises OSError like `open_regular`.

    If a folder ``root`` above it is given, neither the file nor a folder between may be a link.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "the name contains a zero byte", str(path))
    # Without O_NONBLOCK, opening a FIFO would wait for its writer.
    flags |= os.O_NONBLOCK | os.O_CLOEXEC
    try:
        handle = os.open(path, flags, 0o666) if root is None else _open_below(path, root, flags)
    except OSError as error:
        if root is None or error.errno not in (errno.ELOOP, errno.ENOTDIR):
            raise
        raise OSError(errno.ELOOP, "it is a link, or behind a link", str(path)) from error
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    return handle


def _open_below(path: Path, root: Path, flags: int) -> int:
    """Open ``path`` from ``root`` on, folder by folder, so that no link is followed."""
    *folders, name = path.relative_to(root).parts
    handle = os.open(root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    steps = [(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC) for folder in folders]
    for step, how in (*steps, (name, flags)):
        try:
            if step == "..":
                raise OSError(errno.ELOOP, "it leads out of the folder", str(path))
            inner = os.open(step, how | os.O_NOFOLLOW, 0o666, dir_fd=handle)
        finally:
            os.close(handle)
        handle = inner
    return handle


def read_bytes(path: Path, max_bytes: int = MAX_BYTES, *, root: Path | None = None) -> bytes:
    """Read the regular file at ``path``. Raises OSError like `open_own`, and for a larger file."""
    with open_regular(path, root) as file:
        size = os.fstat(file.fileno()).st_size
        if size > max_bytes:
            raise OSError(errno.EFBIG, f"it has {size} bytes, the limit is {max_bytes}", str(path))
        return file.read(max(size, 2**20))  # reserves as much memory; files in /proc have size 0


def read_text(path: Path) -> str:
    """Read UTF-8 text without its byte order mark. Raises OSError (see `read_bytes`), UnicodeDecodeError."""
    return read_bytes(path, MAX_TEXT_BYTES).decode("utf-8-sig")


def read_json(path: Path, max_bytes: int = MAX_TEXT_BYTES, *, root: Path | None = None) -> Any:
    """Read a JSON document. Raises OSError like `read_bytes`, and ValueError if it is not JSON."""
    try:
        return json.loads(read_bytes(path, max_bytes, root=root))
    except RecursionError:
        raise ValueError(TOO_DEEP) from None


def cause(error: Exception) -> str:
    """Return the cause of one of the `FAULTS` in one line, without the path of the file."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    if isinstance(error, KeyError):
        return f"{error.args[0]!r} is missing" if error.args else "something is missing"
    for kind, message in (
        (UnicodeDecodeError, "it is not UTF-8 text"),
        (struct.error, "it is truncated"),
        (OverflowError, "a number is too large"),
        (ZeroDivisionError, "a number is zero that must not be zero"),
        (RecursionError, TOO_DEEP),
    ):
        if isinstance(error, kind):
            return message
    return (str(error).splitlines() or [type(error).__name__])[0]


@contextmanager
def faults_as(
    kind: type[CleargsError], what: str, *, hint: str, faults: tuple[type[Exception], ...] = FAULTS
) -> Iterator[None]:
    """Turn one of the ``faults`` in the block into an error of class ``kind``, worded ``what: cause``."""
    try:
        yield
    except faults as error:
        raise kind(f"{what}: {cause(error)}", hint=hint) from error


def printable(text: str, keep: str = "") -> str:
    r"""Replace control, bidirectional and undecodable characters, except those in ``keep``, by ``\u001b``...

    Names come from files: an escape sequence in a name could write to the clipboard, clear the screen or
    forge a line. The escapes are those of JSON, so that escaped JSON is the same document.
    """
    if text.isascii() and text.isprintable():
        return text
    harmful = {c for c in text if unicodedata.category(c) in _HARMFUL or c in _BIDI}.difference(keep)
    return "".join(f"\\u{ord(character):04x}" if character in harmful else character for character in text)


def require_utf8(path: Path | str) -> None:
    """Raise InputError if the name of ``path`` is not UTF-8, since tables and reports could not store it.

    In a locale with another encoding, libraries would not find a path that is not ASCII.
    """
    if sys.getfilesystemencoding() != "utf-8" and not str(path).isascii():
        raise InputError(
            f"{str(path)!a} is not ASCII, and the locale has the encoding {sys.getfilesystemencoding()}",
            hint="set the environment variable PYTHONUTF8=1, or use a UTF-8 locale such as C.UTF-8",
        )
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise InputError(f"the name of {path} is not UTF-8", hint="rename it") from error
