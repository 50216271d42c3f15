"""Check that an installation is complete. `make test-package` runs this in the environment of the wheel."""

from __future__ import annotations

from importlib.metadata import version
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

import cleargs

CHECKOUT = Path(__file__).resolve().parents[1]
FOLDERS = {"cleargs": "cleargs", "cleargs.stages": "stages", "cleargs.workflows": "workflows"}
NOT_INSTALLED = {"models/weights/README.md", "versions.lock.json"}

for package, name in FOLDERS.items():
    folder, source = Path(str(files(package))), CHECKOUT / name
    assert CHECKOUT not in folder.parents or "site-packages" in folder.parts, f"{package} is the checkout's"
    for path in source.rglob("*"):
        inside = path.relative_to(source)
        if path.is_dir() or path.suffix == ".pyc" or inside.as_posix() in NOT_INSTALLED:
            continue
        assert (folder / inside).is_file(), f"{package} lacks {inside}"
assert find_spec("tools") is None and find_spec("benchmarks") is None
assert version("cleargs") == cleargs.__version__, version("cleargs")
print(f"cleargs {cleargs.__version__} is complete in {files('cleargs')}")
