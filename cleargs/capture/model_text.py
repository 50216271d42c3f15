"""COLMAP's ``images.txt`` as several programs write it. Imports nothing heavy."""

from __future__ import annotations

import re
from pathlib import Path

from cleargs.safe_io import read_text


def image_lines(file: Path) -> list[tuple[str, str]]:
    """Return the line of each image in COLMAP's ``images.txt``, and the line of its keypoints.

    Some programs leave out the empty lines of images without keypoints. A line of keypoints has numbers only.
    Raises OSError and UnicodeDecodeError like `read_text`.
    """
    lines: list[tuple[str, str]] = []
    for line in read_text(file).splitlines():
        words = line.split()
        if line.startswith("#") or not words:
            continue
        if len(words) >= 10 and (len(words) % 3 or not re.fullmatch(r"[-+.\deE]+", words[9])):
            lines.append((line, ""))
        elif lines:
            lines[-1] = lines[-1][0], line
    return lines
