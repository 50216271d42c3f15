"""Text from files on its way to a terminal."""

from __future__ import annotations

import unicodedata

_HARMFUL = ("Cc", "Cs", "Zl", "Zp")
"""Unicode categories that a terminal acts on, or cannot show: control characters, halves of surrogates, line
and paragraph separators."""

_BIDI = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
"""They reorder what stands around them, so that a name may read as another."""


def printable(text: str, keep: str = "") -> str:
    r"""``text`` with control, bidirectional and undecodable characters (but those in ``keep``) as ``\u001b``.

    Names come from files: an escape sequence in one could write the clipboard, clear the screen or forge a
    line. The form is JSON's, so that escaped JSON is the same document.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character if character in keep or not _acts(character) else f"\\u{ord(character):04x}"
        for character in text
    )


def is_utf8(text: str) -> bool:
    """Whether ``text``, a name of a file perhaps, can be written as UTF-8: undecodable bytes cannot."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _acts(character: str) -> bool:
    return unicodedata.category(character) in _HARMFUL or character in _BIDI
