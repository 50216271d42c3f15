"""The files that transforms.json lists. Imports nothing heavy: every run looks up its inputs here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cleargs.errors import InputError
from cleargs.media import IMAGE_SUFFIXES
from cleargs.untrusted import FAULTS, cause, read_json


@dataclass(frozen=True)
class Entry:
    """One entry of ``frames`` and the files that it names."""

    values: Mapping[str, Any]
    image: Path | None
    """None where there is none."""
    mask: Path | None
    """None where it names none, or there is none."""


@dataclass(frozen=True)
class Listing:
    """A transforms.json."""

    common: Mapping[str, Any]
    """All that stands beside ``frames``."""
    entries: tuple[Entry, ...]

    @property
    def files(self) -> dict[str, Path]:
        """Every file that the entries name and that is there, by its name in the listing."""
        images = {entry.values["file_path"]: entry.image for entry in self.entries}
        masks = {entry.values.get("mask_path"): entry.mask for entry in self.entries}
        return {str(name): file for name, file in {**masks, **images}.items() if file is not None}


def read_listing(path: Path) -> Listing:
    """Read transforms.json. Raises InputError where it is damaged or an entry names no image."""
    try:
        data = read_json(path)
        if not isinstance(data, dict) or "frames" not in data:
            raise ValueError("it has no 'frames'")
        frames = data["frames"]
        if not isinstance(frames, list) or not all(isinstance(entry, dict) for entry in frames):
            raise ValueError("'frames' is not a list of objects")
        for number, entry in enumerate(frames):
            if not isinstance(entry.get("file_path"), str):
                raise ValueError(f"frames[{number}] has no file_path")
            if not isinstance(entry.get("mask_path", ""), str):
                raise ValueError(f"frames[{number}] has a mask_path that is no text")
        entries = tuple(
            Entry(
                entry,
                _find_image(path.parent, entry["file_path"]),
                _find(path.parent, entry["mask_path"]) if "mask_path" in entry else None,
            )
            for entry in frames
        )
    except FAULTS as error:
        raise InputError(
            f"cannot read {path}: {cause(error)}",
            hint="it must be a JSON object with a 'frames' list, as nerfstudio or instant-ngp write it",
        ) from error
    return Listing({name: value for name, value in data.items() if name != "frames"}, entries)


def _find(root: Path, listed: str) -> Path | None:
    path = root / listed.replace("\\", "/")
    return path if path.is_file() else None


def _find_image(root: Path, listed: str) -> Path | None:
    """The listed file; where it is listed without an extension, the image of that stem."""
    if (file := _find(root, listed)) is not None:
        return file
    path = root / listed.replace("\\", "/")
    if not path.name or path.suffix.lower() in IMAGE_SUFFIXES:
        return None
    for suffix in sorted(IMAGE_SUFFIXES):
        for spelling in (suffix, suffix.upper()):
            candidate = path.with_name(path.name + spelling)
            if candidate.is_file():
                return candidate
    return None
