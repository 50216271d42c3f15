"""Plugins: entry points of installed packages, in the group of an extension point.

    [project.entry-points."cleargs.evaluators"]
    mine = "my_package.frames:make_evaluator"

A plugin is imported only when a setting names it. Its results may depend only on its arguments and on the
version of its package: that version enters the key of every stage whose settings name the plugin.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import EntryPoint, PackageNotFoundError, entry_points, version
from typing import Any, Literal

from cleargs.errors import InputError, did_you_mean

ExtensionPoint = Literal["evaluators", "experts", "scorers", "candidates", "densifiers", "formats", "layouts"]


def installed_version(distribution: str) -> str:
    """Return the installed version of a package, or "absent"."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "absent"


def plugins(point: ExtensionPoint) -> dict[str, EntryPoint]:
    """Return name -> plugin for an extension point. For equal names, the first package by name wins."""
    found = sorted(entry_points(group=f"cleargs.{point}"), key=package_of, reverse=True)
    return {plugin.name: plugin for plugin in found}


def package_of(plugin: EntryPoint) -> tuple[str, str]:
    """Return the name and version of the package that provides ``plugin``."""
    return ("unknown", "unknown") if plugin.dist is None else (plugin.dist.name, plugin.dist.version)


def load_plugin(point: ExtensionPoint, name: str) -> Any:
    """Import the plugin ``name``, and return the object that its entry point refers to.

    Raises InputError if no package provides the plugin, or if its import fails.
    """
    plugin = plugins(point).get(name)
    if plugin is None:
        raise InputError(
            f"no installed package provides {name!r}",
            hint=f"install a package with this entry point in the group cleargs.{point}",
        )
    try:
        return plugin.load()
    except Exception as error:
        package, version = package_of(plugin)
        raise InputError(
            f"{name} of {package} {version} cannot be loaded: {type(error).__name__}: {error}",
            hint=f"repair or uninstall {package}, or choose another plugin",
        ) from error


def require_known(point: ExtensionPoint, name: str, shipped: Iterable[str]) -> str:
    """Return ``name`` if it is one of ``shipped``, the names that ClearGS provides, or an installed plugin.

    Raises ValueError if it is unknown. The message suggests a known name.
    """
    shipped = tuple(shipped)
    if name in shipped:  # faster: installed packages are not searched
        return name
    names = [*shipped, *plugins(point)]
    if name in names:
        return name
    raise ValueError(did_you_mean(name, names, f"choose {', '.join(names)}"))
