"""A report as one HTML file, with its images, its scene and the 3D viewer inside."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from pathlib import Path

from markupsafe import escape

from cleargs.files import write_bytes
from cleargs.own_files import regular_files
from cleargs.program import program
from cleargs.safe_io import read_bytes

_SCRIPTS = ("viewer.js", "scene.js")
_DATA = '<script type="application/json" id="data">'  # the scripts and images are put in front of it
_BASE64 = 4 / 3  # size ratio


def single_file_size(folder: Path) -> int:
    """Return the approximate size in bytes of the report in ``folder`` as one file, without its text."""
    images = sum(file.stat().st_size for file in folder.rglob("*.jpg"))
    scripts = sum((folder / name).stat().st_size for name in _SCRIPTS if (folder / name).is_file())
    return round(_BASE64 * images) + scripts


def write_single_file(page: Path, target: Path) -> int:
    """Write the report at ``page`` as one HTML file, and return its size in bytes.

    Images that the page shows at once are put in place of their links. The others are in the object
    ``window.files``. Links in the report, which another person may have sent, are left out. Raises StoreError
    if the file cannot be written.
    """
    folder = page.parent
    files = {file.relative_to(folder).as_posix(): file for file in regular_files(folder)}
    images = {
        name: f"data:image/jpeg;base64,{b64encode(file.read_bytes()).decode()}"
        for name, file in files.items()
        if name.endswith(".jpg")
    }
    html, shown = for_others(read_bytes(page, root=folder).decode(), folder.parent), set()

    def with_content(link: re.Match[str]) -> str:
        shown.add(link[1])
        return f' src="{images[link[1]]}"' if link[1] in images else link[0]

    html = re.sub(r' src="([^"]+)"', with_content, html.replace("<html ", "<html data-single ", 1))
    others = {name: image for name, image in images.items() if name not in shown}
    scripts = [files[name].read_text() for name in _SCRIPTS if name in files]
    scripts.append(f"window.files = {json.dumps(others)};")
    inside = "".join(f"<script>{script}</script>\n" for script in scripts)
    data = html.replace(_DATA, inside + _DATA, 1).encode()
    write_bytes(target, data)
    return len(data)


def for_others(html: str, run: Path) -> str:
    """Return a page of ``run`` with ``cleargs`` in its commands, not the path of this machine's program."""
    return html.replace(f"{escape(program(run.parent))} ", "cleargs ")
