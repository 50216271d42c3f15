"""Whether a stage's source changed without its VERSION: the lock file ``stages/versions.lock.json``.

The source of a stage is its module and every ClearGS module that it imports, also inside functions,
transitively, as syntax trees without docstrings, comments and layout. ::

    python -m tools.versions                                what changed
    python -m tools.versions --update                       after VERSION was raised
    python -m tools.versions --update --no-change REASON    the results stay the same bytes
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
from cleargs.pipeline.dag import Dag, installed

LOCK_NAME = "versions.lock.json"

PLAIN_COMMANDS = "cleargs.cli"
"""A package that stages do not compute with; never part of a source."""

Lock = dict[str, dict[str, Any]]
"""Stage -> {"version", "digest", "modules": {module: digest}, "unchanged_because": reason or absent}."""


@dataclass(frozen=True)
class Sources:
    """Where modules lie: dotted prefix -> folder of that package."""

    roots: Mapping[str, Path]

    def file(self, module: str) -> Path | None:
        """The source file of ``module``, or None when it is none of ours."""
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
        """Module -> digest of its tree, for ``module`` and all of ours that it imports, transitively."""
        digests: dict[str, str] = {}
        waiting = [module]
        while waiting:
            name = waiting.pop()
            file = self.file(name)
            if file is None or name in digests or f"{name}.".startswith(f"{PLAIN_COMMANDS}."):
                continue
            tree = ast.parse(file.read_bytes())
            digests[name] = hashlib.sha256("\n".join(_tokens(tree)).encode()).hexdigest()
            package = name if file.name == "__init__.py" else name.rpartition(".")[0]
            waiting += _mentioned(tree, package)
        return dict(sorted(digests.items()))


def installed_sources() -> Sources:
    """The ClearGS packages as they are installed here."""
    stages = sys.modules.get("cleargs.stages") or __import__("cleargs.stages", fromlist=["stages"])
    return Sources({"cleargs": Path(cleargs.__path__[0]), "cleargs.stages": Path(stages.__path__[0])})


def current_lock(dag: Dag, sources: Sources, package: str = "cleargs.stages") -> Lock:
    """The lock that the sources as they are would give."""
    lock: Lock = {}
    for name in dag.names:
        modules = sources.closure(f"{package}.{name}")
        digest = hashlib.sha256(json.dumps(modules, sort_keys=True).encode()).hexdigest()
        lock[name] = {"version": dag.load(name).VERSION, "digest": digest, "modules": modules}
    return lock


def changed_modules(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Modules whose tree differs between two entries of a lock, or that are in one of them only."""
    old, new = before["modules"], now["modules"]
    return sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))


def complaints(before: Lock, now: Lock) -> list[str]:
    """What keeps ``now`` from being locked: sources that changed while VERSION stayed, versions that fell."""
    lines = []
    for stage, entry in now.items():
        locked = before.get(stage)
        if locked is None:
            continue
        if entry["version"] < locked["version"]:
            lines.append(f"{stage}: VERSION fell from {locked['version']} to {entry['version']}")
        elif entry["version"] == locked["version"] and entry["digest"] != locked["digest"]:
            modules = ", ".join(changed_modules(locked, entry))
            lines.append(f"{stage}: VERSION is still {entry['version']}, but these changed: {modules}")
    return lines


def updated_lock(before: Lock, now: Lock, reason: str | None) -> Lock:
    """``now`` as it is to be written. Raises ValueError where it may not be: one line for each cause."""
    problems = complaints(before, now)
    if problems and (reason is None or any("fell" in line for line in problems)):
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
    """The committed lock; empty when there is none."""
    if not path.exists():
        return {}
    lock: Lock = json.loads(path.read_text(encoding="utf-8"))
    return lock


def lock_path(sources: Sources) -> Path:
    """Where the lock file is committed."""
    return sources.roots["cleargs.stages"] / LOCK_NAME


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare with the lock file, or refresh it; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.versions", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--update", action="store_true", help="write the lock file anew")
    parser.add_argument("--no-change", metavar="REASON", help="why the results stay the same bytes")
    options = parser.parse_args(arguments)
    sources = installed_sources()
    before, now = read_lock(lock_path(sources)), current_lock(installed(), sources)
    if not options.update:
        lines = complaints(before, now)
        print("\n".join(lines) or "nothing changed without its VERSION")
        return 1 if lines else 0
    try:
        lock = updated_lock(before, now, options.no_change)
    except ValueError as error:
        print(error, file=sys.stderr)
        print("raise VERSION in the stage, or give --no-change REASON", file=sys.stderr)
        return 1
    write_json(lock_path(sources), lock)
    print(f"wrote {lock_path(sources)}")
    return 0


# -- syntax trees ------------------------------------------------------------------------------------------

MODULE_NAME = re.compile(r"cleargs(\.\w+)+")


def _mentioned(tree: ast.AST, package: str) -> Iterator[str]:
    """Modules that ``tree`` imports, with the packages around them, and those it names in a string.

    A name in a string is how a child process (``python -m NAME``) or a late import is spelt.
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
    """The tree as text without positions and docstrings, equal for every Python version that reads it.

    ``ast.dump`` is not: newer versions have fields that are empty in code of ours.
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
    """Whether ``node`` is a string that stands alone: documentation of whatever is above or around it."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


if __name__ == "__main__":
    sys.exit(main())
