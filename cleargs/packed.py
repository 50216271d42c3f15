"""A packed run: what ``cleargs pack`` writes, unpacked again. It has no images of its capture."""

from __future__ import annotations

from pathlib import Path

from cleargs.base_model import FrozenModel
from cleargs.errors import InputError, StoreError
from cleargs.safe_io import faults_as, read_json

PACK = "pack.json"
"""File in a packed run by which commands know it."""

WORKS = "show, render, export, eval --reference and verify work; for the rest, use the run that was packed"
"""Abilities of a packed run."""


class Pack(FrozenModel):
    """Content of `PACK`."""

    packed_run: str = WORKS
    scene: str
    """Stage whose scene is the file ``scene.ply`` of the packed run."""
    files: tuple[str, ...]
    """Results in the pack, by their paths in the run that was packed."""


def read_pack(run: Path) -> Pack | None:
    """Return the content of `PACK`; None if ``run`` is not packed. Raises StoreError if it is damaged."""
    with faults_as(StoreError, f"cannot read {run / PACK}", hint="unpack the ZIP file again"):
        return Pack.model_validate(read_json(run / PACK, root=run)) if (run / PACK).is_file() else None


def require_images(run: Path, work: str) -> None:
    """Raise InputError if ``run`` is packed, for ``work`` that needs the images of the capture."""
    if (run / PACK).is_file():
        raise InputError(f"{run} is a packed run, without images: {work} is not possible", hint=WORKS)
