"""Where things lie in an input folder. Looks at names only and imports nothing heavy: the runner asks this of
every run, also of one with nothing to do."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from cleargs.capture.config import IngestConfig


def find_model(root: Path) -> Path | None:
    """The folder of the sparse model of a COLMAP project, or None."""
    for folder in (root / "sparse" / "0", root / "sparse", root / "colmap" / "sparse" / "0"):
        if any((folder / f"images.{kind}").is_file() for kind in ("bin", "txt")):
            return folder
    return None


def mask_folder(source: Path) -> Path | None:
    """The folder of masks beside (or in) the folder of images, or None."""
    beside = source.parent / "masks"
    if source.name == "images" and beside.is_dir():
        return beside
    return source / "masks" if (source / "masks").is_dir() else None


def externals(source: Path, config: IngestConfig) -> Mapping[str, Path]:
    """What ingest reads of ``source``: role -> file or folder. A missing input is left to ingest to name."""
    if not source.is_dir():
        return {"capture": source}
    images, masks, transforms = source / "images", mask_folder(source), source / "transforms.json"
    whole = not images.is_dir() or (transforms.is_file() and _lists_outside(transforms))
    found = {"capture": source} if whole else {"images": images}
    if masks is not None:
        found["masks"] = masks
    if transforms.is_file():
        found["transforms"] = transforms
    elif config.poses == "auto" and (model := find_model(source)) is not None:
        found["sparse"] = model
    return found


def _lists_outside(transforms: Path) -> bool:
    """Whether transforms.json may list images elsewhere than in images/ (then the whole folder counts)."""
    try:
        text = transforms.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return True
    listed = re.findall(r'"(?:file_path|mask_path)"\s*:\s*"([^"]*)"', text)
    return not all(re.match(r"(\./)?(images|masks)/", path) for path in listed)
