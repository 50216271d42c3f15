"""Check that a stage whose source changed has a new VERSION, by the lock file ``stages/versions.lock.json``.

The source of a stage is its module and all ClearGS modules that it imports, directly or indirectly, also
inside functions, except `NO_RESULTS`. It is compared as syntax trees without docstrings, comments and layout.
A stage's function ``estimate`` is left out with its imports, because no result depends on an estimate. ::

    python -m tools.versions                                list changes
    python -m tools.versions --update                       after an increase of VERSION
    python -m tools.versions --update --no-change REASON    if the results stay the same byte for byte
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cleargs
from cleargs.files import write_json
from cleargs.pipeline.stages import Stages, installed

LOCK_NAME = "versions.lock.json"

NO_RESULTS = (
    "cleargs.cli",
    "cleargs.errors",
    "cleargs.pipeline.stage",
    "cleargs.progress",
    "cleargs.subprocesses",
    "cleargs.timing",
)
"""Packages and modules on which no byte of a result depends: the command line, messages, progress, times, how
child processes are started, and the interface of stages. They are not part of any source."""

_NO_RESULTS = tuple(f"{name}." for name in NO_RESULTS)

ESTIMATE = "estimate"
"""Function of a stage that returns its expected cost. No result depends on it."""

Lock = dict[str, dict[str, Any]]
"""Stage -> {"version", "digest", "modules": {module: digest}, "unchanged_because": reason or absent}."""


@dataclass(frozen=True)
class Sources:
    """Folders of packages: dotted prefix -> folder."""

    roots: Mapping[str, Path]

    def file(self, module: str) -> Path | None:
        """Return the source file of ``module``, or None if no package in ``roots`` contains it."""
        for prefix in sorted(self.roots, key=len, reverse=True):
            if module == prefix or module.startswith(prefix + "."):
                rest = module.removeprefix(prefix).strip(".").split(".")
                place = self.roots[prefix].joinpath(*(part for part in rest if part))
                for file in (place / "__init__.py", place.with_suffix(".py")):
                    if file.is_file():
                        return file
                return None
        return None

    def closure(self, module: str) -> dict[str, str]:
        """Return the digests of the syntax trees of ``module`` and all its imports, transitively."""
        digests: dict[str, str] = {}
        waiting = [module]
        while waiting:
            name = waiting.pop()
            file = self.file(name)
            if file is None or name in digests or f"{name}.".startswith(_NO_RESULTS):
                continue
            tree = ast.parse(file.read_bytes())
            if name == module:
                tree.body = [node for node in tree.body if getattr(node, "name", None) != ESTIMATE]
            digests[name] = hashlib.sha256("\n".join(_tokens(tree)).encode()).hexdigest()
            package = name if file.name == "__init__.py" else name.rpartition(".")[0]
            waiting += _named_modules(tree, package)
        return dict(sorted(digests.items()))


def installed_sources() -> Sources:
    """Return the folders of the installed ClearGS packages."""
    stages = sys.modules.get("cleargs.stages") or __import__("cleargs.stages", fromlist=["stages"])
    return Sources({"cleargs": Path(cleargs.__path__[0]), "cleargs.stages": Path(stages.__path__[0])})


def current_lock(dag: Stages, sources: Sources, package: str = "cleargs.stages") -> Lock:
    """Return the lock for the current sources."""
    lock: Lock = {}
    for name in dag.names:
        modules = sources.closure(f"{package}.{name}")
        digest = hashlib.sha256(json.dumps(modules, sort_keys=True).encode()).hexdigest()
        lock[name] = {"version": dag.load(name).VERSION, "digest": digest, "modules": modules}
    return lock


def changed_modules(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return the modules that differ between two entries of a lock or are in only one of them."""
    old, new = before["modules"], now["modules"]
    return sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))


def violations(before: Lock, now: Lock) -> list[str]:
    """Return a line for each stage whose source changed without its VERSION, or whose VERSION decreased."""
    lines = []
    for stage, entry in now.items():
        locked = before.get(stage)
        if locked is None:
            continue
        if entry["version"] < locked["version"]:
            lines.append(f"{stage}: VERSION decreased from {locked['version']} to {entry['version']}")
        elif entry["version"] == locked["version"] and entry["digest"] != locked["digest"]:
            modules = ", ".join(changed_modules(locked, entry))
            lines.append(f"{stage}: VERSION is still {entry['version']}, but these changed: {modules}")
    return lines


def updated_lock(before: Lock, now: Lock, reason: str | None) -> Lock:
    """Return the lock to write.

    Args:
        before: The committed lock.
        now: The lock for the current sources.
        reason: The reason why results stay the same if a source changed without its VERSION.

    Raises:
        ValueError: A change needs a reason, or a VERSION decreased; one line per stage.
    """
    problems = violations(before, now)
    if problems and (reason is None or any("decreased" in line for line in problems)):
        raise ValueError("\n".join(problems))
    lock: Lock = {}
    for stage, entry in now.items():
        locked = before.get(stage)
        same_version = locked is not None and locked["version"] == entry["version"]
        if locked is not None and same_version and locked["digest"] == entry["digest"]:
            lock[stage] = locked
        elif same_version:
            lock[stage] = {**entry, "unchanged_because": reason}
        else:
            lock[stage] = entry
    return lock


def read_lock(path: Path) -> Lock:
    """Read the committed lock; return an empty one if it does not exist."""
    if not path.exists():
        return {}
    lock: Lock = json.loads(path.read_text(encoding="utf-8"))
    return lock


def lock_path(sources: Sources) -> Path:
    """Return the path of the lock file."""
    return sources.roots["cleargs.stages"] / LOCK_NAME


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare the sources with the lock file, or update it; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.versions", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--update", action="store_true", help="update the lock file")
    parser.add_argument(
        "--no-change", metavar="REASON", help="the reason why results stay the same byte for byte"
    )
    options = parser.parse_args(arguments)
    sources = installed_sources()
    before, now = read_lock(lock_path(sources)), current_lock(installed(), sources)
    if not options.update:
        lines = violations(before, now)
        print("\n".join(lines) or "no source changed without its VERSION")
        return 1 if lines else 0
    try:
        lock = updated_lock(before, now, options.no_change)
    except ValueError as error:
        print(error, file=sys.stderr)
        print("increase VERSION in the stage, or give --no-change REASON", file=sys.stderr)
        return 1
    write_json(lock_path(sources), lock)
    print(f"wrote {lock_path(sources)}")
    return 0


# -- syntax trees ------------------------------------------------------------------------------------------

MODULE_NAME = re.compile(r"cleargs(\.\w+)+")


def _named_modules(tree: ast.AST, package: str) -> Iterator[str]:
    """Yield the modules and their packages that ``tree`` imports or names in a string.

    Child processes (``python -m NAME``) and late imports name their modules in strings.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield from _with_packages(alias.name)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, *([base] if base else [])])
            yield from _with_packages(base)
            for alias in node.names:
                yield f"{base}.{alias.name}"
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and MODULE_NAME.fullmatch(node.value)
        ):
            yield from _with_packages(node.value)


def _with_packages(module: str) -> Iterator[str]:
    parts = module.split(".")
    for end in range(1, len(parts) + 1):
        yield ".".join(parts[:end])


def _tokens(node: ast.AST) -> Iterator[str]:
    """Yield the tree as text without positions and docstrings.

    The text is the same for all supported Python versions. That of ``ast.dump`` is not: newer versions add
    fields, which are empty for our code.
    """
    yield type(node).__name__
    for name, value in ast.iter_fields(node):
        if name in ("ctx", "kind", "type_comment", "type_ignores", "type_params") or value in (None, []):
            continue
        yield f".{name}"
        items = value if isinstance(value, list) else [value]
        for item in items:
            if isinstance(item, ast.AST):
                if not _is_docstring(item):
                    yield from _tokens(item)
            else:
                yield repr(item)
        yield ";"


def _is_docstring(node: ast.AST) -> bool:
    """Return True if ``node`` is a statement with only a string: it documents a module, class or name."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


if __name__ == "__main__":
    sys.exit(main())
