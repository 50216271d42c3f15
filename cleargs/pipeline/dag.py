"""Which stages there are, and where they come from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import cast

from cleargs.errors import InputError, did_you_mean
from cleargs.pipeline.stage import Stage
from cleargs.progress import Say


@dataclass(frozen=True)
class Dag:
    """Stages in an order in which each comes after all that it reads, and how to load one by name."""

    names: tuple[str, ...]
    load: Callable[[str], Stage]
    pace: Callable[[Say | None], float] = lambda say: 1.0
    """This machine's time over what the stages' estimates were made for. It may take seconds to measure, and
    is measured only where somebody is told (``say``)."""

    def check(self, name: str) -> str:
        """``name``, when there is such a stage. Raises InputError with the nearest name otherwise."""
        if name not in self.names:
            raise InputError(
                f"there is no stage {name!r}",
                hint=did_you_mean(name, self.names, f"the stages are {', '.join(self.names)}"),
            )
        return name

    def until(self, name: str | None) -> tuple[str, ...]:
        """All stages up to and with ``name``; all of them for None."""
        return self.names if name is None else self.names[: self.names.index(self.check(name)) + 1]


def installed() -> Dag:
    """The stages of the package ``cleargs.stages``. Each module is loaded when it is first asked for."""
    package = import_module("cleargs.stages")
    return Dag(tuple(package.STAGES), load_stage, package.pace)


def load_stage(name: str) -> Stage:
    """The module ``cleargs.stages.<name>``."""
    return cast(Stage, import_module(f"cleargs.stages.{name}"))
