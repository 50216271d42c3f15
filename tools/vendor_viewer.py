"""Download the 3D viewer of the reports: ``python -m tools.vendor_viewer`` in a checkout, with npm.

SuperSplat Viewer (PlayCanvas, MIT) is one JavaScript module. It is stored compressed, as in the reports, with
its licence and version. The package from npm must have the digest below.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import subprocess
import tarfile
import tempfile
from pathlib import Path

PACKAGE, VERSION = "@playcanvas/supersplat-viewer", "1.36.2"
SHA512 = "L7w0BlagAonRHQg5qhaDyBB8zrRtiU9QgglNU3kUgsqHpokCAtuf9j4P0kxsUaQn61FZ1qJGkRKsOCbrLCDR0w=="
"""Digest of the package in base64, from npm."""

VIEWER = Path(__file__).parents[1] / "cleargs" / "report" / "static" / "viewer"
_SOURCE_MAP = b"\n//# sourceMappingURL="


def main() -> None:
    """Replace the viewer in this checkout; raise ValueError if the package has another digest."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["npm", "pack", f"{PACKAGE}@{VERSION}", "--ignore-scripts", "--silent"]
        subprocess.run(command, cwd=folder, check=True)
        archive = next(Path(folder).glob("*.tgz"))
        digest = base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
        if digest != SHA512:
            raise ValueError(f"{PACKAGE} {VERSION} has the digest {digest}, expected {SHA512}")
        with tarfile.open(archive) as package:
            module, licence = (_member(package, name) for name in ("public/index.js", "LICENSE"))
    VIEWER.mkdir(parents=True, exist_ok=True)
    code = module.partition(_SOURCE_MAP)[0]  # leaves out the source map
    (VIEWER / "index.js.gz").write_bytes(gzip.compress(code, 9, mtime=0))
    (VIEWER / "LICENSE").write_bytes(licence)
    (VIEWER / "VERSION").write_text(f"{PACKAGE} {VERSION}\n")


def _member(package: tarfile.TarFile, name: str) -> bytes:
    file = package.extractfile(f"package/{name}")
    if file is None:
        raise ValueError(f"{PACKAGE} {VERSION} has no {name}")
    return file.read()


if __name__ == "__main__":
    main()
