"""What other packages add: an entry point in the group of a socket, found by its name when it is asked for.

    [project.entry-points."cleargs.evaluators"]
    mine = "my_package.frames:make_evaluator"

Nothing is imported before a setting names it. What a part computes may depend on its arguments and on the
version of its distribution alone: that version enters the key of every stage whose settings name the part.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, version
from typing import Any, Literal

from cleargs.errors import InputError, did_you_mean

ExtensionPoint = Literal["evaluators", "experts", "scorers", "formats", "layouts"]


def installed_version(distribution: str) -> str:
    """The installed version of a package; "absent" without one."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "absent"


def plugins(point: ExtensionPoint) -> dict[str, EntryPoint]:
    """Name -> part that the installed packages bring for a socket; of two of a name, the first by package."""
    parts = sorted(entry_points(group=f"cleargs.{point}"), key=package_of, reverse=True)
    return {part.name: part for part in parts}


def package_of(part: EntryPoint) -> tuple[str, str]:
    """Name and version of the package that brings ``part``."""
    return ("unknown", "unknown") if part.dist is None else (part.dist.name, part.dist.version)


def load_part(point: ExtensionPoint, name: str) -> Any:
    """What the entry point of that name refers to. Raises InputError where there is none, or it is broken."""
    part = plugins(point).get(name)
    if part is None:
        raise InputError(f"no installed package brings {name!r}", hint=f"install it: cleargs.{point}")
    try:
        return part.load()
    except Exception as error:
        package, version = package_of(part)
        raise InputError(
            f"{name} of {package} {version} cannot be loaded: {type(error).__name__}: {error}",
            hint=f"repair or uninstall {package}, or name another part",
        ) from error


def require_known(point: ExtensionPoint, name: str, shipped: Iterable[str]) -> str:
    """``name``, where it ships with ClearGS or a package brings it. Raises ValueError with what was meant."""
    shipped = tuple(shipped)
    if name in shipped:  # without a look at what is installed
        return name
    names = [*shipped, *plugins(point)]
    if name in names:
        return name
    raise ValueError(did_you_mean(name, names, f"choose {', '.join(names)}"))
