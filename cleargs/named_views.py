"""Named views of a scene in ``RUN/views.json``: the 3D view of the report and web pages offer them.

A view named `START` is the one that they begin with.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from cleargs.base_model import FrozenModel
from cleargs.errors import InputError, StoreError
from cleargs.files import write_json
from cleargs.own_files import refuse_links
from cleargs.safe_io import FAULTS, faults_as, read_json

VIEWS, START = "views.json", "start"
MAX_VIEWS = 50
Point = tuple[float, float, float]


class NamedView(FrozenModel):
    """A camera that looks from ``position`` at ``target`` (normalised world), with the horizon level."""

    name: str
    position: Point
    target: Point


class Views(FrozenModel):
    """Content of `VIEWS`."""

    views: tuple[NamedView, ...] = ()


def read_views(run: Path) -> tuple[NamedView, ...]:
    """Return the views of a run. Raises StoreError if their file is damaged."""
    if not (run / VIEWS).is_file():
        return ()
    with faults_as(StoreError, f"cannot read {run / VIEWS}", hint="delete the file", faults=FAULTS):
        return Views.model_validate(read_json(run / VIEWS, root=run)).views


def keep_views(run: Path, given: Sequence[str]) -> None:
    """Add the views ``NAME=X,Y,Z,X,Y,Z`` (position, target) to those of ``run``; ``NAME=`` removes one.

    Raises InputError for a view that is not of this form.
    """
    views = {view.name: view for view in read_views(run)}
    for text in given:
        name, equals, numbers = text.partition("=")
        views.pop(name, None)
        if numbers or not equals:
            views[name] = _parsed(text, name, numbers)
    if len(views) > MAX_VIEWS:
        raise InputError(f"a run has at most {MAX_VIEWS} views", hint="remove some with --view NAME=")
    refuse_links([run / VIEWS])
    write_json(run / VIEWS, Views(views=tuple(views.values())).model_dump())


def _parsed(text: str, name: str, numbers: str) -> NamedView:
    with suppress(ValueError):  # so is ValidationError, for numbers that are not finite
        values = [float(number) for number in numbers.split(",")]
        if name.strip() and name.isprintable() and len(values) == 6 and values[:3] != values[3:]:
            return NamedView.model_validate({"name": name, "position": values[:3], "target": values[3:]})
    raise InputError(f"--view {text} is not valid", hint="give NAME=X,Y,Z,X,Y,Z: position and target")
