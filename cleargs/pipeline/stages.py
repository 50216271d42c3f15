"""The stages in their order, and how they are loaded."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from importlib import import_module
from typing import cast

from cleargs.errors import InputError, did_you_mean
from cleargs.pipeline.stage import Stage


@dataclass(frozen=True)
class Stages:
    """The stages, in an order in which each comes after the stages that it reads."""

    names: tuple[str, ...]
    load: Callable[[str], Stage]
    """Load a stage by name."""
    gpu_fault: Callable[[BaseException], str | None] = lambda error: None
    """Return one line about the GPU failure that caused an error; None if the GPU is not the cause."""
    prepare: Callable[[Collection[str]], None] = lambda names: None
    """Start what the stages ``names`` will need on the CPU, next to those before them."""

    def check(self, name: str) -> str:
        """Return ``name`` if it is a stage; raise InputError with the nearest name otherwise."""
        if name not in self.names:
            raise InputError(
                f"there is no stage {name!r}",
                hint=did_you_mean(name, self.names, f"choose one of {', '.join(self.names)}"),
            )
        return name

    def until(self, name: str | None) -> tuple[str, ...]:
        """Return all stages up to and including ``name``; all stages for None."""
        return self.names if name is None else self.names[: self.names.index(self.check(name)) + 1]


def installed() -> Stages:
    """Return the stages of the package ``cleargs.stages``. A module is imported when it is first used."""
    package = import_module("cleargs.stages")
    return Stages(tuple(package.STAGES), load_stage, package.gpu_fault, package.prepare)


def load_stage(name: str) -> Stage:
    """Import the module ``cleargs.stages.<name>``."""
    return cast(Stage, import_module(f"cleargs.stages.{name}"))
